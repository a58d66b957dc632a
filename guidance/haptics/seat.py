"""The left player in real time: a person with a hand at a device and a screen.

`RealTimePlayer` implements `guidance.study.games.Participants` for one person, so a game treats real and simulated
people alike. A tick begins with reading the state and the hand; the force follows within milliseconds and is held until
the next tick is due. Frames are drawn in between.
"""

from collections.abc import Callable, Mapping
from math import inf

import numpy as np

from guidance.haptics.hand import HapticHand
from guidance.haptics.safety import NO_FORCE
from guidance.haptics.screen import Clock, DisplayState, Screen
from guidance.haptics.servo import PERIOD
from guidance.haptics.texts import english
from guidance.simulated_users import SimulatedUsers
from guidance.simulated_users.arm import HAND_REACH

MAX_FRAME_DELAY = 0.05  # s; a frame that is later is drawn even if it delays a tick


class RealTimePlayer:
    """One person at a device, see `guidance.study.games.Participants`.

    Args:
        hand: at the device, behind the safety layer.
        screen: before the person.
        clock: of the game.
        tick_seconds: s, duration of a tick.
        breath: s of rest between rounds.
        person: the simulated person at the device, if there is one.
        texts: `notes.hold`, `notes.paused` and `notes.fault` in the language of the person.

    Attributes:
        display: what the screen shows; the owner of the game writes scores, titles and predictions into it.
        mark: callback for events: pauses, their ends and faults.
        keys: pressed and not taken yet.
        actions: key -> what it does; of a key that is pressed in a pause, the screen shows it.
        latencies: s from reading state and hand to the force, for every tick.
        late_ticks, pauses, faults: of this game: number of ticks that began more than a tick late; number of pauses,
            without the rests between rounds; messages of the faults.
    """

    def __init__(
        self,
        hand: HapticHand,
        screen: Screen,
        clock: Clock,
        tick_seconds: float,
        breath: float = 1.0,
        person: SimulatedUsers | None = None,
        texts: Mapping[str, str] | None = None,
    ) -> None:
        self.hand, self.screen, self.clock, self.person = hand, screen, clock, person
        self.texts, self.actions = texts or english(), {}
        self.tick_seconds, self.breath = tick_seconds, breath
        self._steps = round(tick_seconds / PERIOD)
        self.mark: Callable[[str], None] = lambda event: None
        self.display, self.keys, self.latencies = DisplayState(), [], []
        self.late_ticks, self.pauses, self.faults = 0, 0, []
        self._due = self._observed = clock.now()
        self._first, self._no_state = True, np.zeros(12)

    @property
    def action(self) -> np.ndarray:
        """(1, 2) the position of the hand over its reach."""
        return np.clip(np.array(self.hand.position) / HAND_REACH, -1.0, 1.0)[None]

    def new_game(self, mask: np.ndarray) -> None:
        """Begin a game after a rest; its forces ramp up."""
        self.late_ticks, self.pauses, self.faults = 0, 0, []
        self.display.state = self.display.previous_state = None
        self.hand.rest()
        self._breathe(is_held=False)
        if self.person is not None:
            self.person.new_game(mask)

    def new_round(self, mask: np.ndarray) -> None:
        """Begin a round after a rest, if `mask` (1,) is True."""
        if mask[0]:
            self._breathe(is_held=True)
            if self.person is not None:
                self.person.new_round(mask)

    def step(self, state: np.ndarray, force: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Apply `force` (1, 2) N to the hand until the next tick is due; returns the action (1, 2) at that time."""
        hand, clock, display, screen = self.hand, self.clock, self.display, self.screen
        hand.push((float(force[0, 0]), float(force[0, 1])), screen.has_focus)
        self.latencies.append(clock.now() - self._observed)
        display.previous_state = state[0].copy() if self._first else display.state
        display.state, self._first, done, action = state[0].copy(), False, 0, None
        start, self._due = self._due, self._due + self.tick_seconds
        while (now := clock.now()) < self._due:
            passed = min(int((now - start) / PERIOD), self._steps)
            hand.advance(passed - done, state[0])
            done = max(passed, done)
            # a frame must not delay a tick, unless it would otherwise never be drawn
            fits = self._due - now > screen.frame_cost or now - screen.next_frame > MAX_FRAME_DELAY
            if now >= screen.next_frame and fits:
                display.tick_fraction = (now - start) / self.tick_seconds
                if self._draw() or not screen.has_focus:
                    action = self.action
                    self.pause()
                    start = self._due - self.tick_seconds
            else:
                wake = screen.next_frame if screen.next_frame > now else self._due
                clock.wait(min(wake, self._due) - now)
        screen.poll()
        hand.advance(self._steps - done, state[0])
        if hand.fault is not None:  # the game must not go on without its forces
            action = self.action if action is None else action
            self.pause()
        if clock.now() - self._due > self.tick_seconds:
            self.late_ticks, self._due = self.late_ticks + 1, clock.now()
        self._observed = clock.now()
        return self.action if action is None else action  # movements during a pause are no action

    def pause(self) -> None:
        """Rest without a force until the person presses space; after a fault, only once it is released.

        Raises:
            RuntimeError: a fault, and no screen to report it.
        """
        self.pauses += 1
        self.mark("pause")
        self._rest(inf, self.texts["notes.paused"], is_held=False)
        self.mark("go on")

    def _breathe(self, is_held: bool) -> None:
        """Rest between rounds or games; space turns it into a pause."""
        if self.breath > 0 and self._rest(self.breath, self.display.note, is_held):
            self.pause()
        self._first = True

    def _rest(self, seconds: float, note: str, is_held: bool) -> bool:
        """Stop the game for some seconds; returns whether space ended the rest.

        Args:
            is_held: whether the hand stays at the device, so that the next force need not ramp up.
        """
        clock, screen, hand, start, done = self.clock, self.screen, self.hand, self.clock.now(), 0
        display, is_ended = self.display, False
        display.note, note = note, display.note
        while (now := clock.now()) < start + seconds or hand.fault is not None:
            if screen.next_frame == inf and hand.fault is not None:
                raise RuntimeError(f"no force: {hand.fault}")
            hand.push(NO_FORCE, is_held and screen.has_focus)
            if self.person is None:  # no time passes for a simulated person
                passed = int((now - start) / PERIOD)
                hand.advance(passed - done, self._no_state)
                done = passed
            if now >= screen.next_frame:
                if self._draw() and screen.has_focus and hand.fault is None:
                    is_ended = True
                    break
                pending = [self.actions[key] for key in self.keys if key in self.actions] if seconds == inf else []
                display.next_action = pending[-1] if pending else ""
            end = start + seconds if start + seconds > now else inf
            clock.wait(min(screen.next_frame, end, now + self.tick_seconds) - now)
        display.note, display.next_action = note, ""
        self._due = self._observed = clock.now()
        return is_ended

    def _draw(self) -> bool:
        """Draw a frame; returns whether space was pressed."""
        display, fault = self.display, self.hand.fault
        display.hand, display.force = self.action[0], np.array(self.hand.force)
        if fault and (not self.faults or self.faults[-1] != fault):
            self.faults.append(fault)
            self.mark(f"fault: {fault}")
        note = display.note
        if fault:
            display.note = self.texts["notes.fault"].format(fault=fault)
        elif not self.hand.is_held and not note:
            display.note = self.texts["notes.hold"]
        pressed = self.screen.frame(display)
        display.note = note
        if fault and "r" in pressed:
            self.hand.release()
        self.keys += [key for key in pressed if key != "space"]
        return "space" in pressed

    def take_keys(self) -> list[str]:
        """The keys pressed since the last call."""
        keys, self.keys = self.keys, []
        return keys
