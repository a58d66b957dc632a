"""The window on a virtual screen: its pixels and its keys."""

import os
from functools import cache
from math import atan2, hypot

import numpy as np
import pygame
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from airhockey_marl.envs.physics import LEFT, PUCK, RIGHT, TableSpec
from airhockey_marl.envs.rendering import COLORS, FELT
from airhockey_marl.experiment.config import CONF, InputError
from guidance.display.arena import Arena
from guidance.display.drawing import DEJAVU, choose_font, clear_caches, font, lacking, use_font, wrap
from guidance.display.pages import MARGIN, Items, Page
from guidance.display.scene import ARROW, FORCE, GRAY, HAND, PAPER, TARGETS
from guidance.display.window import BAR, MIN_WIDTH, Window
from guidance.forces.conditions import Prediction
from guidance.haptics.screen import DisplayState, Quit, SimulatedClock
from guidance.haptics.texts import flatten_texts, read_consent
from tests import ROOT

STATE = np.array([-0.5, 0.1, 0, 0, 0.6, -0.2, 0, 0, 0.2, 0.3, 0, 0])
EVERY_GLYPH, STIX = DEJAVU.with_name("LastResortHE-Regular.ttf"), DEJAVU.with_name("STIXGeneral.ttf")
ITEMS = {name: f"How {name}?" for name in ("helpful", "natural", "controllable", "comfortable")}


@pytest.fixture
def window():
    window = Window("test", TableSpec(), MIN_WIDTH, 60, SimulatedClock(), {"o": "targets", "h": "help"})
    yield window
    window.close()


def moment(**changes) -> DisplayState:
    state = changes.pop("state", STATE)
    return DisplayState(
        state=state, previous_state=state, tick_fraction=1.0, **{"hand": np.array([-0.03, 0.2]), **changes}
    )


def press(*keys: int | str) -> None:
    for key in keys:
        text = key if isinstance(key, str) else ""
        code = pygame.key.key_code(key) if isinstance(key, str) else key
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=code, unicode=text, mod=0))


def screenshot(window: Window) -> np.ndarray:
    return pygame.surfarray.array3d(window.surface).swapaxes(0, 1).astype(int)


def shown(window: Window, now: DisplayState) -> np.ndarray:
    """(height, width, 3) the picture, without the trails of those before."""
    window.arena.trail = []
    window.frame(now)
    return screenshot(window)


def color_at(window: Window, picture: np.ndarray, x: float, y: float) -> tuple[int, ...]:
    column, row = window.arena.pixel(np.array([x, y]))
    return tuple(picture[round(row) + BAR, round(column)])


def test_the_puck_and_the_paddles_are_where_they_are(window):
    picture = shown(window, moment(hand=np.array([0.9, 0.9])))
    assert color_at(window, picture, 0.2, 0.3) == COLORS[PUCK]
    assert color_at(window, picture, -0.5 + 0.036, 0.1) == COLORS[LEFT]
    assert color_at(window, picture, 0.6 - 0.036, -0.2) == COLORS[RIGHT]


def test_nothing_changes_where_nothing_moves_and_the_puck_changes_where_it_was_and_is(window):
    first, again = shown(window, moment()), shown(window, moment())
    assert np.array_equal(first, again)
    moved = STATE.copy()
    moved[8:10] = -0.2, -0.35
    changed = np.argwhere(np.abs(shown(window, moment(state=moved)) - first).max(axis=2) > 8) - [BAR, 0]
    radius = window.arena.scale * TableSpec().puck_radius + 3
    places = [window.arena.pixel(np.array(place))[::-1] for place in ((0.2, 0.3), (-0.2, -0.35))]
    near = [np.hypot(*(changed - place).T) < radius for place in places]
    assert all(mask.sum() > 300 for mask in near) and (near[0] | near[1]).all()


def test_between_two_ticks_a_body_is_between_two_places(window):
    later = STATE.copy()
    later[8:10] = 0.3, 0.3
    picture = shown(
        window, DisplayState(state=later, previous_state=STATE, tick_fraction=0.5, hand=np.array([0.9, 0.9]))
    )
    assert color_at(window, picture, 0.25, 0.3) == COLORS[PUCK]
    assert color_at(window, picture, 0.25 + 0.04, 0.3) != COLORS[PUCK]


@pytest.mark.parametrize("force", [(2.0, 0.0), (0.0, 1.5), (-1.5, 1.5), (1.0, -2.5)])
def test_the_arrow_is_the_force(window, force):
    picture = shown(window, moment(force=np.array(force)))
    green = np.argwhere((picture[BAR : BAR + window.arena.size[1]] == FORCE).all(axis=2))
    start = np.array(window.arena.pixel(STATE[:2]))
    away = green[:, ::-1] - start
    right, down = away[np.argmax(np.hypot(*away.T))]
    assert abs(atan2(-down, right) - atan2(force[1], force[0])) < 0.1
    assert abs(hypot(right, down) - hypot(*force) * ARROW * window.arena.scale) < 4
    foot = picture[BAR + window.arena.size[1] :]
    assert (foot == FORCE).all(axis=2).sum() > 50  # and in newtons


def test_an_experiment_does_not_show_what_is_to_be_felt(window):
    window.shows_force = False
    now = moment(force=np.array([2.0, 1.0]), weights={"W_sim": 0.5})
    without = moment(force=np.zeros(2))
    assert np.array_equal(shown(window, now), shown(window, without))


def test_a_serve_leaves_no_trail(window):
    window.frame(moment())
    served = STATE.copy()
    served[8:10] = -0.4, -0.4
    window.frame(moment(state=served))
    picture = screenshot(window)
    assert color_at(window, picture, -0.1, -0.05) == FELT


def test_predictions_are_shown_by_a_key_unless_in_an_experiment(window):
    targets = {
        name: Prediction(torch.tensor([[x, -0.5]]), torch.full((1, 2), 0.2))
        for name, x in (("optimal", -0.4), ("predicted", 0.5))
    }
    now = moment(**targets)

    def marked() -> list[bool]:
        picture = shown(window, now)
        return [bool((picture == TARGETS[name]).all(axis=2).sum() > 10) for name in TARGETS]

    assert marked() == [False, False]
    press("o")
    assert marked() == [True, True]
    press("o")
    assert marked() == [False, False]
    window.keys = {"h": "help"}  # in the laboratory
    press("o")
    assert marked() == [False, False]


@given(action=st.tuples(st.floats(-1, 1), st.floats(-1, 1)), width=st.integers(MIN_WIDTH, 2000))
def test_the_pointer_asks_for_the_place_under_it(action, width):
    arena = arena_of(width // 400)
    assert np.allclose(arena.action_at(arena.of_action(np.array(action))), action, atol=1e-9)


@cache
def arena_of(size: int) -> Arena:
    pygame.display.init()
    pygame.display.set_mode((100, 100))
    return Arena(TableSpec(), 400 * size)


def test_the_pointer_handler_gets_the_action(window):
    told = []
    window.on_pointer = told.append
    x, y = window.arena.of_action(np.array([0.5, -0.25]))
    pygame.mouse.set_pos(round(x), round(y) + BAR)
    window.poll()
    assert np.allclose(told[-1], [0.5, -0.25], atol=0.02)


def test_keys_come_once_and_the_window_keeps_its_own(window):
    press("3", "a", "page up", "space")
    assert window.frame(moment()) == ["3", "a", "page up", "space"] and window.frame(moment()) == []
    press("h", "3")
    assert window.frame(moment()) == ["3"] and not window.has_focus
    press("space")
    assert window.frame(moment()) == [] and window.has_focus  # closes the help, and starts nothing
    pygame.event.post(pygame.event.Event(pygame.JOYBUTTONDOWN, button=0, instance_id=0))
    assert window.frame(moment()) == ["space"]


def test_another_window_takes_the_focus(window):
    for event, attentive in ((pygame.WINDOWFOCUSLOST, False), (pygame.WINDOWFOCUSGAINED, True)):
        pygame.event.post(pygame.event.Event(event))
        window.poll()
        assert window.has_focus == attentive


@pytest.mark.parametrize(
    "event",
    [pygame.event.Event(pygame.QUIT), pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE, unicode="", mod=0)],
)
def test_closing_and_escape_leave(window, event):
    for show in (lambda: window.frame(moment()), lambda: window.page(Page("a", "b", {"return": "go"}))):
        pygame.event.post(event)
        with pytest.raises(Quit):
            show()
    assert window.frame(moment()) == []  # and leave nothing behind


def test_a_disconnected_gamepad_reaches_its_handler(window):
    gone = []
    window.on_disconnect = gone.append
    pygame.event.post(pygame.event.Event(pygame.JOYDEVICEREMOVED, instance_id=7))
    window.poll()
    assert gone == [7]


def test_frames_are_sixty_a_second_and_missed_ones_are_missed(window):
    for _ in range(60):
        window.clock.wait(window.next_frame - window.clock.now())
        window.frame(moment())
    assert window.clock.now() == pytest.approx(59 / 60) and np.allclose(window.frame_times, 1 / 60)
    window.clock.wait(1.0)
    window.frame(moment())
    assert window.next_frame >= window.clock.now()


def test_full_screen_and_back_keeps_the_picture(window):
    before = shown(window, moment())
    press("f")
    window.frame(moment())
    press("f")
    assert np.array_equal(shown(window, moment()), before)


def test_a_page_waits_for_one_of_its_keys(window):
    press("x", "y", "return")
    assert window.page(Page("Title", "Text", {"y": "yes", "n": "no"})) == "y"


def test_a_long_text_is_several_pages_and_none_of_it_is_lost(window):
    words = [f"word{i}" for i in range(2000)]
    parts = Page("Title", " ".join(words), {"y": "yes", "n": "no"}).parts(window.size)
    assert len(parts) > 2 and " ".join(part.text.replace("\n", " ") for part in parts).split() == words
    assert [list(part.keys) for part in parts] == [["space"]] * (len(parts) - 1) + [["y", "n"]]
    for part in parts:
        part.draw(window.surface)
        assert (screenshot(window)[-20:] == PAPER).all()
    press("y", *["space"] * (len(parts) - 1), "n")
    assert window.page(Page("Title", " ".join(words), {"y": "yes", "n": "no"})) == "n"


def test_escape_empties_a_line_and_then_leaves(window):
    press("a", "b", "escape", "c", "return")
    assert window.write_down(Page("Interview", "What?", {})) == "c"
    press("escape")
    with pytest.raises(Quit):
        window.write_down(Page("Interview", "What?", {}))


def test_the_mouse_can_be_seen_where_it_answers(window):
    window.toggle_fullscreen()
    press("1", "2", "3", "4", "enter")
    window.ask(Items("How was it?", ITEMS, "not at all", "very much"))
    window.toggle_fullscreen()
    assert pygame.mouse.get_visible()


def test_before_a_game_there_is_an_empty_table(window):
    window.frame(DisplayState(title="Game 1 of 9"))
    picture = screenshot(window)[BAR : BAR + window.arena.size[1]]
    assert not any((picture == COLORS[body]).all(axis=2).any() for body in (PUCK, RIGHT))


def test_a_questionnaire_by_keys(window):
    press("5", "[6]", "up", "7", "return", "2", "1", "return")  # a return before the last is answered confirms nothing
    items = Items("How was it?", ITEMS, "not at all", "very much")
    assert window.ask(items) == {"helpful": 5, "natural": 7, "controllable": 2, "comfortable": 1}


def test_a_questionnaire_by_mouse_and_what_is_chosen_is_seen(window):
    items = Items("How was it?", ITEMS, "not at all", "very much")
    size = window.surface.get_size()
    for number, (point, name) in enumerate(zip((1, 4, 7, 2), ITEMS, strict=True)):
        box = items._box(number, point, size)
        pygame.event.post(pygame.event.Event(pygame.MOUSEBUTTONDOWN, pos=box.center, button=1))
        window.poll()
        for event in window._events():
            items.click(event.pos, size)
        items.draw(window.surface)
        assert window.surface.get_at((box.left + 4, box.centery))[:3] == COLORS[LEFT]
        assert items.answers[name] == point
    items.press("0")
    items.press("8")
    assert list(items.answers.values()) == [1, 4, 7, 2]


def test_a_note_is_written_down(window):
    press("f", "i", "n", "x", "backspace", "e", "return")
    assert window.write_down(Page("Interview", "What?", {})) == "fine"


@pytest.mark.parametrize("width", [MIN_WIDTH, 1100, 1600])
@pytest.mark.parametrize("language", ["en", "de"])
def test_every_text_fits(width, language):
    from guidance.commands.lab import KEYS as LAB_KEYS
    from guidance.commands.play import KEYS

    content = yaml.safe_load((CONF / "questions" / f"{language}.yaml").read_text(encoding="utf-8"))
    content["scale"][0] = "not at all, never, on no account"  # longer than any that is shipped
    content["questions"]["comfort"] *= 3
    text = {key.removeprefix("texts."): value for key, value in flatten_texts(content).items()}
    window = Window("test", TableSpec(), width, 60, SimulatedClock(), {}, texts=text)
    title = text["next_game.title"].format(number=10, games=10)
    nine = {str(i): "(i) CombHG (UT+UA+SC)" for i in range(1, 10)}
    consent = read_consent(ROOT / "guidance" / "sessions" / "consent" / f"{language}.txt", 9)
    begin = {"return": text["every_game.begin"], "s": text["practice.skip"]}
    agreement = {"y": text["consent.agree"], "n": text["consent.decline"]}
    every = "\n\n".join(text[f"every_game.{name}"] for name in ("familiarization", "rounds"))
    pages = Page(text["consent.title"], consent, agreement, text).parts(window.size)
    pages += [Page(title, f"{text[key]}\n\n{every}", begin, text) for key in ("first_game.text", "next_game.text")]
    pages += [Page(title, text["practice.text"], begin, text), Page("Keys", "", nine | KEYS, text)]
    pages += [Page(text["window.help"], "", {key: text[f"keys.{key}"] for key in LAB_KEYS}, text)]
    for page in pages:
        page.draw(window.surface)
        edges = screenshot(window)
        for part in (edges[:, -20:], edges[-20:], edges[:, :20]):
            assert (part == PAPER).all(), page.title
    items = Items(text["items.title"].format(game=title), content["questions"], *content["scale"], text)
    for _ in range(4):
        items.draw(window.surface)
        edges = screenshot(window)
        assert (edges[:, -20:] == PAPER).all() and (edges[-20:] == PAPER).all()
        assert (edges[:, : MARGIN - 20] == PAPER).all()
        items.press("4")
    weights = {"W_unc optimal": 1.0, "W_unc predicted": 0.5, "W_sim": 0.2}
    busy = moment(
        title="CombHG (UT+UA+SC), generation 100",
        weights=weights,
        force=np.array([2.0, 2.0]),
        won=10,
        lost=10,
        seconds=3599,
        note=text["notes.fault"].format(fault="the hand is 0.123 m away from the center, more than 0.11 m"),
    )
    picture = shown(window, busy)
    bar, foot = picture[:BAR], picture[-30:]
    assert (bar[:, -8:] == PAPER).all() and (foot[:, -8:] == PAPER).all()
    grey = np.flatnonzero((foot == GRAY).all(axis=2).any(axis=0)).max()  # the end of the last weight
    assert (foot[:, grey + 1 : grey + 12] == PAPER).all()  # a gap before the keys: nothing overlaps
    window.close()


def test_a_note_covers_nothing_of_the_table(window):
    empty, noted = shown(window, moment()), shown(window, moment(note="no force: " + "a" * 80))
    changed = np.argwhere((empty != noted).any(axis=2))[:, 0]
    assert len(changed) and changed.min() >= BAR + window.arena.size[1]


def test_the_ring_of_the_hand_is_in_a_legend(window):
    bar = shown(window, moment())[:BAR]
    assert (bar == HAND).all(axis=2).sum() > 20


def test_a_key_in_a_pause_is_answered(window):
    paused = shown(window, moment(note="paused"))
    then = shown(window, moment(note="paused", next_action="OAHG"))
    assert (paused != then).any()


def test_text_without_spaces_and_long_words_are_split():
    for text in ("마" * 300, "https://" + "x" * 300, "short " + "y" * 300):
        lines = wrap(text, 19, 400)
        assert "".join(lines).replace(" ", "") == text.replace(" ", "") and len(lines) > 5
        assert all(font(19, False, text).size(line)[0] <= 400 for line in lines)


def test_a_font_is_chosen_that_has_all_characters(monkeypatch):
    assert choose_font("Wie angenehm war die Führung? – „gut“") == DEJAVU
    assert lacking("한국 ab", DEJAVU) == ["국", "한"]
    assert choose_font("한국어") == DEJAVU  # there is no other
    monkeypatch.setattr("guidance.display.drawing.installed_fonts", lambda: (STIX, EVERY_GLYPH))
    assert choose_font("한국어 ab") == EVERY_GLYPH
    assert choose_font("한국어", STIX) == STIX  # as it was asked for
    use_font(EVERY_GLYPH)
    assert font(19, False, "한국어 ab").size("한") != pygame.font.Font(DEJAVU, 19).size("한")
    clear_caches()


@pytest.mark.parametrize("driver", ["offscreen", "dummy"])
def test_without_a_display_there_is_no_window(monkeypatch, driver):
    """Unless an invisible one is asked for."""
    monkeypatch.delenv("SDL_VIDEODRIVER")
    monkeypatch.setattr("pygame.display.get_driver", lambda: driver)
    with pytest.raises(InputError, match=r"^window: there is no display here"):
        Window("test", TableSpec(), MIN_WIDTH, 60, SimulatedClock(), {})


def test_what_a_library_complains_of_is_not_shown(monkeypatch, capfd):
    monkeypatch.setattr("pygame.display.init", lambda: os.write(2, b"error: XDG_RUNTIME_DIR is not set"))
    monkeypatch.setattr("pygame.display.get_driver", lambda: "offscreen")
    monkeypatch.delenv("SDL_VIDEODRIVER")
    with pytest.raises(InputError):
        Window("test", TableSpec(), MIN_WIDTH, 60, SimulatedClock(), {})
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("driver", ["x11", "nonsense"])
def test_a_driver_that_cannot_start_is_named(monkeypatch, driver):
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(InputError, match=rf"^window: it cannot be opened with SDL_VIDEODRIVER={driver}: .*available"):
        Window("test", TableSpec(), MIN_WIDTH, 60, SimulatedClock(), {})


def test_a_window_must_fit_on_a_screen(monkeypatch):
    monkeypatch.setattr("pygame.display.get_driver", lambda: "x11")
    monkeypatch.setattr("pygame.display.get_desktop_sizes", lambda: [(640, 480), (1024, 768)])
    with pytest.raises(InputError, match=r"^width = 1100 must be smaller: .* does not fit on a screen of 1024 by 768"):
        Window("test", TableSpec(), 1100, 60, SimulatedClock(), {})
    Window("test", TableSpec(), 1000, 60, SimulatedClock(), {}).close()


def test_a_full_screen_that_the_display_refuses_is_an_error(monkeypatch):
    set_mode = pygame.display.set_mode

    def refuse(size, flags=0):
        if flags & pygame.FULLSCREEN:
            raise pygame.error("no fullscreen")
        return set_mode(size, flags)

    monkeypatch.setattr("pygame.display.set_mode", refuse)
    with pytest.raises(InputError, match=r"^window: it cannot be opened.*: no fullscreen"):
        Window("test", TableSpec(), MIN_WIDTH, 60, SimulatedClock(), {}, fullscreen=True)
