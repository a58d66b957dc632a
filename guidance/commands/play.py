"""Play air hockey yourself, and feel the nine guidances.

    airhockey play                                 mouse, against generation 55
    airhockey play opponent=60 device=gamepad      another opponent, another device
    airhockey play condition=oahg_ut overlay=true  begin with a guidance, and show the models' predictions

1 to 9 choose one of the conditions (a) to (i), letters those of `beyond`, a adapts the user model to you, h shows all
keys. Writes into its run folder, for every part played under one condition, a table with a row per tick (`..._beh.tsv`)
and its description (`.json`), and counts.csv (their rounds, shots and smashes). `airhockey watch run=<that folder>`
films them.
"""

from __future__ import annotations

from collections.abc import Sequence
from string import ascii_lowercase
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import write_text
from airhockey_marl.experiment.registry import construct
from airhockey_marl.experiment.run_folder import output_folder

if TYPE_CHECKING:
    from guidance.forces.conditions import Condition

KEYS = {  # those that choose a condition come before them
    "a": "make the user model yours, from what you have played without guidance",
    "o": "show where the models would go (mean and STD)",
    "page up, page down": "a stronger, a weaker opponent",
    "space": "pause",
    "h": "these keys",
    "f": "full screen",
    "r": "after a safety stop: feel forces again",
    "escape": "leave",
}


def condition_keys(conditions: Sequence[Condition]) -> dict[str, Condition]:
    """Key -> condition: 1 to 9 for the paper's, for another its letter, or a free one if the window has that."""
    free, keys = [key for key in ("0", *ascii_lowercase) if key not in KEYS], {}
    for condition in conditions:
        digit = "abcdefghi".find(condition.letter) + 1
        key = str(digit) if digit else condition.letter if condition.letter in free else free[0]
        keys[key] = condition
        free = [other for other in free if other != key]
    return keys


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "frames_per_second")
    require_numbers(cfg, "breath", least=0.0, at_most=10.0)
    if cfg.seconds is not None:
        require_numbers(cfg, "seconds")


def main(cfg: DictConfig) -> None:
    from airhockey_marl.envs.physics import TableSpec
    from airhockey_marl.league.league import League
    from guidance.display.window import MIN_WIDTH, Window
    from guidance.forces.conditions import ADAPTED
    from guidance.haptics.open_device import DEVICES, device_session
    from guidance.haptics.safety import SafetyLimits
    from guidance.haptics.screen import WallClock, quit_on_signals
    from guidance.haptics.seat import RealTimePlayer
    from guidance.sessions.free_play import FreePlay
    from guidance.simulated_users import SimulatedUsers, load_advisors, load_population, sample_people
    from guidance.simulated_users.adaptation import is_on
    from guidance.study.protocol import CALIBRATION_GAME, Protocol, user_and_table_states
    from guidance.study.setup import load_conditions, load_lookahead, load_models

    with report_input_errors():
        require_counts(cfg, "width", least=MIN_WIDTH)
        protocol: Protocol = construct(Protocol, cfg.study, "study")
        device = DEVICES.build(cfg.device, "device")
        begin_with: Condition = load_conditions(cfg)[0]
        if ADAPTED in begin_with.guidance.models():
            raise InputError(f"condition = {begin_with.name} needs a model of you: begin with another, and press a")
        cfg.condition = None
        conditions = load_conditions(cfg)
        conditions += [begin_with] * all(begin_with.name != condition.name for condition in conditions)
        choices = condition_keys(conditions)
        models, lookahead = load_models(cfg), load_lookahead(cfg)
        opponents = League.load(cfg.models.opponents)
        opponents.player(cfg.opponent)
        limits: SafetyLimits = construct(SafetyLimits, cfg.safety, "safety")
        minds, serves = user_and_table_states(cfg.seed, [0], CALIBRATION_GAME)
        person = None
        if cfg.device.kind == "simulated":
            people, advisors = sample_people(1, cfg.seed, load_population(cfg.users)), load_advisors(cfg.users.advisors)
            how = cfg.users.variant, advisors, is_on(cfg.users.adaptation)
            person = SimulatedUsers(people, minds, TableSpec(), *how)
    folder, clock, table = output_folder(cfg), WallClock(), TableSpec()
    keys = {key: f"({condition.letter}) {condition.label}" for key, condition in choices.items()} | KEYS
    with (
        Window("Air hockey", table, cfg.width, cfg.frames_per_second, clock, keys) as window,
        device_session(device, limits, person) as open_device,
    ):
        window.overlay = cfg.overlay
        window.on_pointer, window.on_disconnect = open_device.on_pointer, open_device.on_disconnect
        seat = RealTimePlayer(open_device.hand, window, clock, table.tick, cfg.breath, person)
        seat.actions = keys | {"page up": "a stronger opponent", "page down": "a weaker opponent"}
        play = FreePlay(
            choices, models, opponents, cfg.opponent, lookahead, protocol.round_seconds, seat, serves, folder
        )
        with quit_on_signals():
            play.run(begin_with, cfg.seconds)
    write_text(folder / "counts.csv", play.counts().to_csv(index=False))
    columns = ["rounds", "win_rate", "mean_smash_speed", "defense_rate", "mean_disagreement"]
    print(play.summary()[columns].to_string(float_format="%.2f", na_rep="–"))
    print(f"\nagain: airhockey watch run={folder}")
