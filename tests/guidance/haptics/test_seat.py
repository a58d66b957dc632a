"""The real-time player on a simulated clock: punctual ticks, forces, pauses and faults."""

import numpy as np
import pytest

from guidance.haptics.devices.pointer import Mouse
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.screen import NullDisplay, Quit, SimulatedClock
from guidance.haptics.seat import RealTimePlayer
from guidance.haptics.servo import InProcessServo
from guidance.simulated_users.arm import HAND_REACH

STATE, FORCE = np.arange(12.0)[None], np.array([[1.5, -0.5]])


class Hand:
    """A hand that records its calls and their times."""

    def __init__(self, clock: SimulatedClock) -> None:
        self.clock, self.position, self.force, self.fault = clock, (0.03, -0.06), (0.0, 0.0), None
        self.pushed, self.passed, self.released, self.is_held = [], 0, False, True

    def push(self, force, is_held=True) -> None:
        self.pushed.append((self.clock.now(), force, is_held))

    def advance(self, milliseconds, state) -> None:
        self.passed += milliseconds

    def rest(self) -> None:
        self.pushed.append((self.clock.now(), "rest", False))

    def release(self) -> bool:
        self.released, self.fault = True, None
        return True


class Screen:
    """A screen whose frames take some time, and whose keys are pressed at given times."""

    def __init__(self, clock: SimulatedClock, cost: float = 0.0, keys: dict[float, str] | None = None) -> None:
        self.clock, self.frame_cost, self.keys = clock, cost, dict(keys or {})
        self.next_frame, self.has_focus, self.frames, self.notes = 0.0, True, [], []
        self.actions: dict[float, str] = {}  # by the time to a tenth of a second

    def poll(self) -> None:
        pass

    def frame(self, moment) -> list[str]:
        self.frames.append(self.clock.now())
        self.notes.append(moment.note)
        self.actions[round(self.clock.now(), 1)] = moment.next_action
        self.clock.wait(self.frame_cost)
        self.next_frame = max(self.next_frame + 1 / 60, self.clock.now())
        assert self.clock.now() < 60, "somebody waits for ever"
        due = [self.keys.pop(at) for at in list(self.keys) if at <= self.clock.now()]
        if "escape" in due:
            raise Quit
        return due


def make_player(cost: float = 0.0, keys: dict[float, str] | None = None, dark: bool = False) -> RealTimePlayer:
    clock = SimulatedClock()
    return RealTimePlayer(Hand(clock), NullDisplay() if dark else Screen(clock, cost, keys), clock, 0.02, breath=0.0)


def test_fifty_ticks_are_a_second_in_which_the_hand_lives_a_thousand_milliseconds():
    seat = make_player()
    for _ in range(50):
        action = seat.step(STATE, FORCE)
    assert seat.clock.now() == pytest.approx(1.0, abs=1e-9)
    assert seat.hand.passed == 1000 and len(seat.screen.frames) == 60 and seat.late_ticks == 0
    assert {force for _, force, _ in seat.hand.pushed} == {(1.5, -0.5)} and len(seat.hand.pushed) == 50
    assert np.allclose(action, np.array([[0.03, -0.06]]) / HAND_REACH) and action.shape == (1, 2)


def test_a_hand_beyond_its_reach_acts_at_the_edge():
    seat = make_player(dark=True)
    seat.hand.position = (0.2, -0.2)
    assert np.array_equal(seat.step(STATE, FORCE), [[1.0, -1.0]])


@pytest.mark.parametrize("cost", [0.002, 0.008, 0.012])
def test_no_picture_makes_a_tick_late(cost):
    seat = make_player(cost)
    for _ in range(100):
        seat.step(STATE, FORCE)
    times = np.array([time for time, _, _ in seat.hand.pushed])
    assert np.allclose(np.diff(times), 0.02, atol=1e-6)
    assert len(seat.screen.frames) >= 100 and seat.late_ticks == 0  # and there is one in every tick


def test_a_screen_that_is_too_slow_for_any_tick_still_shows_something():
    seat = make_player(cost=0.03)
    for _ in range(200):
        seat.step(STATE, FORCE)
    apart = np.diff(seat.screen.frames)
    assert len(apart) > 20 and apart.max() < 0.2


def test_a_late_tick_is_counted_and_skipped():
    seat = make_player(dark=True)
    seat.step(STATE, FORCE)
    seat.clock.wait(0.5)
    seat.step(STATE, FORCE)
    assert seat.late_ticks == 1
    for _ in range(3):
        seat.step(STATE, FORCE)
    assert np.allclose([time for time, _, _ in seat.hand.pushed], [0, 0.52, 0.52, 0.54, 0.56]) and seat.late_ticks == 1


def test_space_pauses_without_a_force_until_space():
    seat = make_player(keys={0.05: "space", 3.0: "space"})
    for _ in range(10):
        seat.step(STATE, FORCE)
    without = [time for time, force, _ in seat.hand.pushed if force == (0.0, 0.0)]
    assert len([1 for _, force, _ in seat.hand.pushed if force == (1.5, -0.5)]) == 10
    assert min(without) < 0.08 and 2.9 < max(without) <= 3.02
    assert np.diff(without).max() < 0.04  # never stale: it is asked for no force, again and again
    assert any(note.startswith("paused") for note in seat.screen.notes) and seat.display.note == ""
    assert seat.clock.now() == pytest.approx(3.0 + 8 * 0.02, abs=0.05)


def test_after_a_pause_and_in_a_new_game_a_force_starts_softly():
    clock = SimulatedClock()
    hand = InProcessServo(Mouse(), SafetyLimits())
    seat = RealTimePlayer(hand, Screen(clock, keys={3.0: "space", 4.0: "space"}), clock, 0.02, breath=1.0)

    def strength(ticks: int) -> float:
        for _ in range(ticks):
            seat.step(STATE, FORCE)
        return float(np.hypot(*hand.force))

    whole = float(np.hypot(1.5, 0.5))
    assert strength(1) < 0.1 * whole and strength(60) == pytest.approx(whole)
    seat.new_game(np.array([True]))
    assert strength(1) < 0.1 * whole and strength(30) == pytest.approx(whole)
    while seat.pauses == 0:
        seat.step(STATE, FORCE)
    assert strength(1) < 0.15 * whole and strength(60) == pytest.approx(whole)
    seat.new_round(np.array([True]))
    assert strength(2) > 0.9 * whole  # within a game the hand stays where it is


def test_keys_in_a_pause_are_announced_and_act_after_it():
    player = make_player(keys={0.1: "space", 0.3: "2", 0.5: "3", 0.6: "x", 1.0: "space"})
    player.actions = {"2": "OAHG", "3": "UPHG"}
    for _ in range(20):
        player.step(STATE, FORCE)
    actions = [player.screen.actions[time] for time in (0.2, 0.4, 0.7, 1.1)]
    assert actions == ["", "OAHG", "UPHG", ""] and player.take_keys() == ["2", "3", "x"]


def test_movements_in_a_pause_are_no_action():
    seat = make_player(keys={0.05: "space", 3.0: "space"})
    frame = seat.screen.frame

    def move(moment) -> list[str]:
        if seat.clock.now() > 1.0:
            seat.hand.position = (-0.07, 0.07)
        return frame(moment)

    seat.screen.frame = move
    actions = [seat.step(STATE, FORCE)[0] for _ in range(5)]
    assert seat.pauses == 1 and np.allclose(actions[:3], np.array([0.03, -0.06]) / HAND_REACH)
    assert np.allclose(actions[3:], np.array([-0.07, 0.07]) / HAND_REACH)
    assert np.allclose(seat.action, actions[-1])  # from which the next tick begins


def test_space_turns_a_rest_into_a_pause():
    clock = SimulatedClock()
    seat = RealTimePlayer(Hand(clock), Screen(clock, keys={0.3: "space", 5.0: "space"}), clock, 0.02, breath=1.0)
    seat.new_round(np.array([True]))
    assert 5.0 <= clock.now() < 5.1 and seat.pauses == 1


def test_a_note_asks_to_take_hold_of_the_device():
    seat = make_player()
    seat.hand.is_held = False
    seat.step(STATE, FORCE)
    assert seat.screen.notes[-1] == "take hold of the device"


def test_without_focus_the_game_pauses_without_a_force_until_space():
    seat = make_player(keys={2.0: "space"})
    seat.screen.has_focus = False
    frame = seat.screen.frame

    def look_up(moment) -> list[str]:
        seat.screen.has_focus = seat.clock.now() > 1.0
        return frame(moment)

    seat.screen.frame = look_up
    seat.step(STATE, FORCE)
    assert 2.0 <= seat.clock.now() < 2.1
    assert not any(held for _, _, held in seat.hand.pushed)  # so that the next force starts softly
    assert not any(any(force) for time, force, _ in seat.hand.pushed if 0.02 < time < 2.0)


def test_escape_quits_a_game_and_a_pause():
    for keys in ({0.1: "escape"}, {0.1: "space", 0.5: "escape"}):
        seat = make_player(keys=keys)
        with pytest.raises(Quit):
            for _ in range(100):
                seat.step(STATE, FORCE)


def test_after_a_fault_the_game_waits_for_its_release_and_for_space():
    seat = make_player(keys={0.5: "space", 1.0: "x", 1.5: "r", 2.0: "space"})
    seat.hand.fault = "the hand moves at 9 m/s"
    seat.step(STATE, FORCE)
    assert 2.0 <= seat.clock.now() < 2.1 and seat.hand.released
    assert "no force: the hand moves at 9 m/s; r, then space" in seat.screen.notes
    assert not any(any(force) for time, force, _ in seat.hand.pushed if time > 0)
    assert seat.take_keys() == ["x", "r"] and seat.take_keys() == []
    seat.hand.released = False
    seat.step(STATE, FORCE)
    assert not seat.hand.released and seat.clock.now() < 2.2


def test_a_fault_before_a_round_prolongs_the_rest():
    clock = SimulatedClock()
    seat = RealTimePlayer(Hand(clock), Screen(clock, keys={3.0: "r", 4.0: "space"}), clock, 0.02, breath=1.0)
    seat.hand.fault = "the hand is too far out"
    seat.new_round(np.array([True]))
    assert 3.0 <= clock.now() < 3.1


def test_without_a_screen_a_fault_is_an_error():
    seat = make_player(dark=True)
    seat.hand.fault = "the device failed"
    with pytest.raises(RuntimeError, match="no force: the device failed"):
        seat.step(STATE, FORCE)


def test_there_is_a_rest_between_rounds():
    clock = SimulatedClock()
    seat = RealTimePlayer(Hand(clock), Screen(clock), clock, 0.02, breath=1.0)
    seat.step(STATE, FORCE)
    seat.new_round(np.array([False]))
    assert clock.now() == pytest.approx(0.02)
    seat.new_round(np.array([True]))
    assert clock.now() == pytest.approx(1.02, abs=0.02)
    seat.step(STATE + 1, FORCE)
    assert np.array_equal(
        seat.display.previous_state, STATE[0] + 1
    )  # nothing moves across the table from the round before
