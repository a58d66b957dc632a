"""Mouse, gamepad and simulated person: where the hand is, with a force and without."""

import math
import os

import numpy as np
import pytest

from airhockey_marl.envs.physics import LEFT
from airhockey_marl.envs.world import World
from guidance.haptics.devices import DeviceError
from guidance.haptics.devices.gamepad import RUMBLE_MS, Gamepad, open_gamepad
from guidance.haptics.devices.pointer import MAX_SPEED, Mouse, median_person
from guidance.haptics.devices.simulated import Simulated
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.servo import InProcessServo
from guidance.simulated_users import Population, SimulatedUsers, personal_streams, sample_people
from guidance.simulated_users.arm import HAND_REACH

STEP, SEEN = 0.001, np.zeros(12)
SETTLED = 6.0  # s, twenty time constants of the median arm


def pass_time(device, seconds, force=(0.0, 0.0)):
    device.set_force(force)
    for _ in range(round(seconds / STEP)):
        device.advance(STEP, SEEN)


# the arm and the pointer


def test_the_median_person_has_the_median_arm():
    person, arm = median_person(), Population.default()
    for name in ("stiffness", "arm_mass", "muscle_lag"):
        assert person[name] == arm[name].median
        people = sample_people(400, 5)[name]
        assert 0.4 < (people < person[name]).mean() < 0.6
    assert person["device_mass"] == arm["device_mass"] and person["damping_time"] == arm["damping_time"]


def test_without_a_force_the_hand_is_exactly_at_the_pointer():
    mouse = Mouse()
    for x, y in ((0.03, -0.02), (-0.075, 0.075), (0.0, 0.0)):
        mouse.point(x, y)
        pass_time(mouse, 0.2)
        assert mouse.position == (x, y)
        assert mouse.velocity == (0.0, 0.0)


@pytest.mark.parametrize("force", [(2.0, 0.0), (-1.2, 1.6)])
def test_a_constant_force_deflects_by_force_over_stiffness(force):
    mouse, stiffness = Mouse(), float(median_person()["stiffness"])
    mouse.point(0.01, 0.02)
    pass_time(mouse, SETTLED, force)
    assert mouse.position == pytest.approx((0.01 + force[0] / stiffness, 0.02 + force[1] / stiffness), abs=1e-6)
    assert mouse.velocity == pytest.approx((0.0, 0.0), abs=1e-6)
    pass_time(mouse, SETTLED)
    assert mouse.position == pytest.approx((0.01, 0.02), abs=1e-6)


def test_a_stiffer_arm_yields_less():
    stiff = median_person()
    stiff["stiffness"] *= 2
    hands = [Mouse(), Mouse(person=stiff)]
    for mouse in hands:
        pass_time(mouse, SETTLED, (3.0, 0.0))
    assert hands[0].position[0] == pytest.approx(2 * hands[1].position[0], rel=1e-3)


def test_the_arm_has_inertia():
    # of 1.25 kg in all, 1 N gives 0.8 m/s2 at first
    mouse = Mouse()
    pass_time(mouse, 0.003, (1.0, 0.0))
    assert mouse.velocity[0] == pytest.approx(0.003 * 0.8, rel=0.05)


def test_the_velocity_is_that_of_the_position_whatever_moves_the_hand():
    mouse, rng = Mouse(), np.random.default_rng(2)
    for step in range(400):
        if step % 20 == 0:
            mouse.point(*rng.uniform(-0.09, 0.09, 2))
            mouse.set_force(tuple(rng.uniform(-3, 3, 2)))
        was = np.array(mouse.position)
        mouse.advance(STEP, SEEN)
        assert (np.array(mouse.position) - was) / STEP == pytest.approx(mouse.velocity, abs=1e-9)


def test_a_pointer_that_leaps_is_followed_no_faster_than_a_hand_can():
    mouse = Mouse()
    mouse.point(0.06, -0.06)
    mouse.advance(STEP, SEEN)
    assert math.hypot(*mouse.velocity) == pytest.approx(MAX_SPEED)
    assert mouse.position == pytest.approx((MAX_SPEED * STEP / math.sqrt(2), -MAX_SPEED * STEP / math.sqrt(2)))
    away = 0.06 * math.sqrt(2)
    pass_time(mouse, math.ceil(away / MAX_SPEED / STEP) * STEP)
    assert mouse.position == (0.06, -0.06)


def test_the_hand_stops_at_its_reach():
    mouse = Mouse()
    mouse.point(1.0, -math.inf)
    pass_time(mouse, 0.5)
    assert mouse.position == (HAND_REACH, -HAND_REACH)
    pass_time(mouse, 0.5, (3.0, -3.0))
    assert mouse.position == (HAND_REACH, -HAND_REACH) and mouse.velocity == (0.0, 0.0)
    mouse.point(HAND_REACH, 0.0)
    pass_time(mouse, SETTLED, (-3.0, 0.0))
    assert mouse.position[0] == pytest.approx(HAND_REACH - 3.0 / 150.0, abs=1e-5)


def test_a_pointer_that_was_far_outside_is_back_at_once():
    mouse = Mouse()
    mouse.point(10.0, 0.0)
    pass_time(mouse, 1.0)
    mouse.point(HAND_REACH - 0.01, 0.0)
    pass_time(mouse, 0.01)  # 0.01 m at 1.5 m/s take less
    assert mouse.position == (HAND_REACH - 0.01, 0.0)


def test_long_steps_are_short_steps_of_the_arm():
    fine, coarse = Mouse(), Mouse()
    pass_time(fine, 0.1, (2.0, 1.0))
    coarse.set_force((2.0, 1.0))
    for _ in range(5):
        coarse.advance(0.02, SEEN)
    assert coarse.position == pytest.approx(fine.position, rel=1e-9)


def test_relaxing_and_closing_a_mouse_end_the_force():
    for end in ("relax", "close"):
        mouse = Mouse()
        pass_time(mouse, 1.0, (3.0, 0.0))
        getattr(mouse, end)()
        for _ in range(round(SETTLED / STEP)):
            mouse.advance(STEP, SEEN)
        assert mouse.position == pytest.approx((0.0, 0.0), abs=1e-6)


# the gamepad


class Pad:
    """A joystick that a test moves and pulls out."""

    def __init__(self):
        self.axes, self.here, self.broken, self.done = [0.0, 0.0], True, False, []

    def get_init(self):
        return self.here

    def get_instance_id(self):
        return 7

    def get_axis(self, axis):
        if self.broken:
            raise RuntimeError("Joystick not initialized")
        return self.axes[axis]

    def rumble(self, low, high, milliseconds):
        self.done.append((low, high, milliseconds))
        return True

    def stop_rumble(self):
        self.done.append("stop")

    def quit(self):
        self.done.append("quit")


def gamepad(**keywords):
    pad = Pad()
    return pad, Gamepad(pad, limit=3.0, **keywords)


@pytest.mark.parametrize(
    ("axes", "hand"),
    [
        ((1.0, 0.0), (1.0, 0.0)),  # right is toward the opponent
        ((0.0, -1.0), (0.0, 1.0)),  # up, which a stick calls -1, is to one's left
        ((-1.0, 0.0), (-1.0, 0.0)),
        ((math.sqrt(0.5), math.sqrt(0.5)), (1.0, -1.0)),  # the circle's edge is the square's corner
        ((1.0, 1.0), (1.0, -1.0)),
        ((0.0, 0.55), (0.0, -0.5)),  # half-way between a dead zone of 0.1 and the edge
        ((0.1, 0.0), (0.0, 0.0)),
        ((0.07, -0.07), (0.0, 0.0)),  # the dead zone is round: here it goes on to 0.0707
        ((0.08, 0.08), ((0.08 * math.sqrt(2) - 0.1) / 0.9, -(0.08 * math.sqrt(2) - 0.1) / 0.9)),
    ],
)
def test_the_stick_points_the_hand(axes, hand):
    pad, device = gamepad(dead_zone=0.1)
    pad.axes = list(axes)
    pass_time(device, 0.3)
    assert device.position == pytest.approx((HAND_REACH * hand[0], HAND_REACH * hand[1]), abs=1e-12)


def test_a_force_deflects_the_pads_hand_as_the_mouses():
    mouse, (_, device) = Mouse(), gamepad()
    for either in (mouse, device):
        pass_time(either, 0.123, (1.0, -2.0))
    assert device.position == mouse.position and device.velocity == mouse.velocity


def test_the_pad_rumbles_as_strongly_as_the_force():
    pad, device = gamepad()
    pass_time(device, 0.01)
    assert pad.done == []
    pass_time(device, 0.01, (0.9, 1.2))
    assert pad.done == [(0.5, 0.5, RUMBLE_MS)]
    pass_time(device, 0.01, (0.9, 1.25))  # hardly more
    assert len(pad.done) == 1
    pass_time(device, 0.01, (9.0, 0.0))
    assert pad.done[1:] == [(1.0, 1.0, RUMBLE_MS)]
    pass_time(device, 0.01, (0.05, 0.0))
    assert pad.done[2:] == ["stop"]


def test_a_rumble_is_renewed_before_it_ends_by_itself():
    pad, device = gamepad()
    pass_time(device, 1.0, (3.0, 0.0))
    assert pad.done == [(1.0, 1.0, RUMBLE_MS)] * 10


@pytest.mark.parametrize("how", ["event", "quit", "error"])
def test_a_disconnected_pad_is_not_held(how):
    pad, device = gamepad()
    pad.axes = [1.0, 0.0]
    pass_time(device, 0.2)
    assert device.is_held
    device.disconnect(6)  # another one
    assert device.is_held
    pad.axes = [0.0, 0.0]
    if how == "event":
        device.disconnect(7)
    else:
        pad.here, pad.broken = how != "quit", how == "error"
    pass_time(device, 0.2)
    assert not device.is_held
    with pytest.raises(DeviceError, match="the gamepad is gone"):
        device.position  # noqa: B018
    servo = InProcessServo(device, SafetyLimits())
    servo.push((1.0, 0.0))
    servo.advance(5, np.zeros(12))
    assert servo.fault == "the device failed: the gamepad is gone; leave, plug it in, and go on"
    assert servo.force == (0.0, 0.0) and not servo.release()


def test_closing_a_pad_stops_its_rumble():
    pad, device = gamepad()
    pass_time(device, 0.01, (3.0, 0.0))
    device.close()
    device.close()
    assert pad.done[1:] == ["stop", "quit"] and not device.is_held


def test_there_is_no_pad_where_none_is_connected(monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setitem(os.environ, "SDL_VIDEODRIVER", "dummy")
    pygame.joystick.init()
    count = pygame.joystick.get_count()
    try:
        with pytest.raises(DeviceError, match=rf"^gamepad = {count} must be .* of which there are {count}$"):
            open_gamepad(count)
    finally:
        pygame.joystick.quit()


# the simulated person


def person(seed=4, table=None):
    return SimulatedUsers(sample_people(1, seed), personal_streams(1, seed), table)


def game(ticks, act):
    """Play alone against a paddle that rests: `act` maps what is seen (12,) to where the hand then is (2,)."""
    tables, seen, actions = World(1), np.empty((1, 12)), np.zeros((1, 2, 2))
    tables.seed(9)
    tables.new_rounds()
    trail = []
    for _ in range(ticks):
        tables.observe(LEFT, seen)
        hand = act(seen[0].copy())
        trail.append(hand)
        actions[0, LEFT] = np.array(hand) / HAND_REACH
        tables.step(actions)
    return np.array(trail)


@pytest.mark.parametrize("force", [(0.0, 0.0), (0.7, -1.3)])
def test_a_simulated_person_at_the_device_plays_as_without_one(force):
    users, device = person(), Simulated(person())

    def directly(seen):
        users.step(seen[None], np.array([force]))
        return users.hand[0].copy()

    def at_the_device(seen):
        for step in range(20):
            assert device.position == tuple(device.users.hand[0])
            device.set_force(force)
            # only what was seen as the tick began counts
            device.advance(STEP, seen if step == 0 else np.full(12, 1e9))
        return device.position

    without, at_it = game(500, directly), game(500, at_the_device)
    assert np.array_equal(without, at_it)
    assert np.ptp(without, axis=0).min() > 0.01  # they did play
    assert device.velocity == tuple(users.hand_velocity[0])


def test_the_force_of_a_tick_is_the_mean_of_what_acted_in_it():
    users, device, seen = person(), Simulated(person()), np.zeros(12)
    for step in range(20):
        device.set_force((0.1 * step, -1.0 if step < 5 else 1.0))
        device.advance(STEP, seen)
    users.step(seen[None], np.array([[0.95, 0.5]]))
    assert device.position == pytest.approx(tuple(users.hand[0]), abs=1e-15)
    assert device.position[0] > 0


def test_a_tick_is_twenty_steps_however_they_come():
    devices = [Simulated(person()) for _ in range(2)]
    for device in devices:
        device.set_force((2.0, 0.0))
    for _ in range(60):
        devices[0].advance(STEP, SEEN)
    for seconds in (0.007, 0.033, 0.02):
        devices[1].advance(seconds, SEEN)
    assert devices[0].position == devices[1].position != (0.0, 0.0)
    devices[0].advance(0.019, SEEN)
    assert devices[0].position == devices[1].position
    devices[0].advance(STEP, SEEN)
    assert devices[0].position != devices[1].position


def test_a_new_game_of_the_person_is_a_new_game_at_the_device():
    device = Simulated(person())
    device.set_force((3.0, 0.0))
    device.advance(0.1, SEEN)
    assert device.position != (0.0, 0.0)
    device.users.new_game(np.array([True]))
    assert device.position == (0.0, 0.0) and device.is_held


def test_relaxing_ends_the_force_on_the_person():
    device, users = Simulated(person()), person()
    device.set_force((3.0, 0.0))
    device.relax()
    device.advance(0.02, SEEN)
    users.step(SEEN[None], np.zeros((1, 2)))
    assert device.position == tuple(users.hand[0])
