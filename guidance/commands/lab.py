"""Run the paper's experiment with one person: consent, practice, a game for UA, nine conditions, ratings, rests.

    airhockey lab participant=new                    somebody new, under a random label
    airhockey lab participant=P01                    P01, from where their session stopped
    airhockey lab participant=P01 device=mouse       without a haptic device
    airhockey lab participant=P01 withdraw=true      delete everything of P01
    airhockey lab participant=S1 device=simulated window=false    a simulated person takes the seat
    airhockey report runs=outputs/lab/records        the study so far, analyzed as any other

The games are those of `guidance.evaluate`, in the same order and under the same forces. The records (`records=`) are a
folder laid out as BIDS; finished games are never lost, see `guidance.sessions.bids`.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import load_json
from airhockey_marl.experiment.registry import construct

if TYPE_CHECKING:
    from guidance.sessions.bids import Records
    from guidance.sessions.participant import Participant
    from guidance.sessions.session import SessionPlan
    from guidance.study.models import Models

KEYS = ("space", "h", "f", "r", "escape")  # of the window
NEW = "new"
OF_A_SESSION = (
    "participant",
    "withdraw",
    "records",
    "window",
    "fullscreen",
    "width",
    "font",
    "lsl",
)  # not of the study


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "participants", "frames_per_second")
    require_numbers(cfg, "breath", least=0.0, at_most=10.0)
    if not cfg.window and cfg.device.kind != "simulated":
        raise InputError(f"window = false must be true for device = {cfg.device.kind}: somebody looks at it")


def facts_of(cfg: DictConfig, models: Models, plan: SessionPlan) -> dict:
    """The manifest of the study; two with other devices, limits, questions or kinds of people are not the same one."""
    from guidance.study.setup import file_hashes, manifest

    facts = manifest(cfg, file_hashes(cfg, models), "", 0.0)
    people = "simulated" if cfg.device.kind == "simulated" else "people"
    content = [facts["study_hash"], OmegaConf.to_container(cfg.device), OmegaConf.to_container(cfg.safety), people]
    content += [dict(plan.questions), list(plan.scale), cfg.breath, plan.consent, list(map(repr, plan.conditions))]
    content += [dict(plan.texts)]
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    # without the participant of this session, who may withdraw
    config = {key: value for key, value in facts["config"].items() if key not in OF_A_SESSION}
    return facts | {"study_hash": digest, "participants": people, "command": "airhockey lab", "config": config}


def plan_of(cfg: DictConfig, models: Models) -> SessionPlan:
    """What the configuration has everybody do."""
    from guidance.haptics.texts import check_texts, flatten_texts, read_consent
    from guidance.sessions.session import SessionPlan
    from guidance.study.protocol import Protocol
    from guidance.study.setup import load_conditions, load_lookahead, load_opponent

    conditions = load_conditions(cfg)
    texts = flatten_texts(OmegaConf.to_container(cfg, resolve=True))
    check_texts(texts, place_of)
    return SessionPlan(
        conditions=conditions,
        models=models,
        opponent=load_opponent(cfg),
        opponent_label=f"generation {cfg.opponent}",
        protocol=construct(Protocol, cfg.study, "study"),
        lookahead=load_lookahead(cfg),
        participants=cfg.participants,
        seed=cfg.seed,
        consent=read_consent(Path(cfg.consent), len(conditions)),
        questions=OmegaConf.to_container(cfg.questions),
        scale=tuple(cfg.scale),
        texts={key.removeprefix("texts."): text for key, text in texts.items() if key.startswith("texts.")},
        interview=cfg.interview,
        device=cfg.device.kind,
    )


def place_of(key: str) -> str:
    """A key of the texts, after the yaml that it is from unless it was typed."""
    job = HydraConfig.get()
    choice = job.runtime.choices["questions"]
    typed = {argument.partition("=")[0].lstrip("+~") for argument in job.overrides.task} - {"questions"}
    file = choice if choice.endswith(".yaml") else f"conf/questions/{choice}.yaml"
    return key if any(f"{key}.".startswith(f"{name}.") for name in typed) else f"{file}: {key}"


def font_for(cfg: DictConfig, plan: SessionPlan) -> Path:
    """A font that can draw everything that is shown.

    Raises:
        ValueError: there is none; names the characters, the key and the file.
    """
    from guidance.display.drawing import choose_font, lacking
    from guidance.haptics.texts import unshaped

    shown = {f"consent = {cfg.consent}": plan.consent}
    shown |= {place_of(f"questions.{name}"): text for name, text in plan.questions.items()}
    shown |= {place_of(f"scale.{number}"): text for number, text in enumerate(plan.scale)}
    shown |= {place_of(f"texts.{name}"): text for name, text in plan.texts.items()}
    for place, text in shown.items():
        if characters := listed(unshaped(text)):
            raise ValueError(f"{place} has {characters}, which the window cannot join or order as they are read")
    font = choose_font("".join(shown.values()), cfg.font and Path(cfg.font))
    for place, text in shown.items():
        if characters := listed(lacking(text, font)):
            advice = (
                "choose another" if cfg.font else "install one, such as Noto Sans CJK, or choose one by font=<file>"
            )
            raise ValueError(f"{place} has {characters}, for which there is no font: {advice}")
    return font


def listed(characters: Iterable[str], most: int = 10) -> str:
    """Up to `most` characters in words, those that cannot be seen by their numbers."""
    unique = list(dict.fromkeys(characters))
    names = [character if character.isprintable() else f"U+{ord(character):04X}" for character in unique[:most]]
    return " ".join(names + ["..."] * (len(unique) > most))


def main(cfg: DictConfig) -> None:
    from airhockey_marl.envs.physics import TableSpec
    from guidance.display.window import MIN_WIDTH, Window
    from guidance.haptics.open_device import DEVICES, device_session
    from guidance.haptics.safety import SafetyLimits
    from guidance.haptics.screen import NullDisplay, Quit, SimulatedClock, WallClock, quit_on_signals
    from guidance.haptics.seat import RealTimePlayer
    from guidance.sessions.bids import Records
    from guidance.sessions.lsl import LabStreams
    from guidance.sessions.session import Session
    from guidance.sessions.simulated_participant import SimulatedParticipant
    from guidance.simulated_users import load_population, sample_people
    from guidance.study.protocol import balance_note
    from guidance.study.setup import load_models

    with report_input_errors():
        require_counts(cfg, "width", least=MIN_WIDTH)
        device = DEVICES.build(cfg.device, "device")
        population = load_population(cfg.users)
    if cfg.withdraw:
        withdraw(Path(cfg.records), str(cfg.participant))
        return
    with report_input_errors():
        models = load_models(cfg)
        plan, limits = plan_of(cfg, models), construct(SafetyLimits, cfg.safety, "safety")
        people = sample_people(cfg.participants, cfg.seed, population)
        facts = facts_of(cfg, models, plan)
        font = font_for(cfg, plan) if cfg.window else None
        streams = LabStreams() if cfg.lsl else None
    clock = WallClock() if cfg.window else SimulatedClock()
    participant = None
    with suppress(Quit), ExitStack() as room:
        room.enter_context(quit_on_signals())  # until the records are closed
        window = open_device = simulated = None
        if cfg.window:
            title, rate = plan.texts["window.title"], cfg.frames_per_second
            keys = {key: plan.texts[f"keys.{key}"] for key in KEYS}
            look = {"shows_force": False, "texts": plan.texts, "font_file": font, "fullscreen": cfg.fullscreen}
            window = room.enter_context(Window(title, TableSpec(), cfg.width, rate, clock, keys, **look))
        if cfg.device.kind != "simulated":  # nobody is enrolled, and no study begun, before there is something to hold
            open_device = room.enter_context(device_session(device, limits))
        with report_input_errors():
            records = room.enter_context(Records(cfg.records, facts))
        is_first, note = not records.places, balance_note(cfg.participants, len(plan.conditions))
        participant = enrolled(records, cfg)
        if is_first and note:
            print(f"note: {note}", file=sys.stderr)
        room.callback(dismiss, records, participant)
        if open_device is None:
            simulated = SimulatedParticipant(people, participant.place, cfg.seed, cfg.users)
            open_device = room.enter_context(device_session(device, limits, simulated.users))
        breath = cfg.breath if cfg.window else 0.0
        seat = RealTimePlayer(
            open_device.hand, window or NullDisplay(), clock, TableSpec().tick, breath, texts=plan.texts
        )
        if window is not None:
            window.on_pointer, window.on_disconnect = open_device.on_pointer, open_device.on_disconnect
        events = {"on_game": lambda game: simulated.begin_game(seat, game)} if simulated else {}
        events |= {"mark": streams.mark, "on_row": streams.tick} if streams else {}
        Session(plan, participant, seat, window or simulated, **events).run()
    if participant is None or participant.consent is None:
        return
    done = sum(game.ratings is not None for game in participant.games.values())
    hint = "" if done == len(plan.conditions) else f" It goes on with participant={participant.label}."
    print(f"{participant.label}: {done} of {len(plan.conditions)} games are played and rated.{hint}")
    print(f"\nrecords: {records.folder}")


def withdraw(folder: Path, label: str) -> None:
    """Delete everything of a person, whatever the study's configuration is."""
    from guidance.sessions.bids import Records

    with report_input_errors():
        if not (folder / "manifest.json").is_file():
            raise InputError(f"records = {folder} holds no study")
        with Records(folder, load_json(folder / "manifest.json")) as records:
            records.withdraw(label)
    print(f"{label} has withdrawn: everything of theirs in {folder} is deleted")


def dismiss(records: Records, participant: Participant) -> None:
    """Delete everything of a participant who has not consented."""
    if participant.consent is None:
        records.withdraw(participant.label, counted=False)
        print(f"{participant.label} does not take part; nothing of theirs is kept")


def enrolled(records: Records, cfg: DictConfig) -> Participant:
    """The participant that the configuration names, or a new one."""
    with report_input_errors():
        label = None if cfg.participant == NEW else str(cfg.participant)
        if label not in records.places and len(records.places) >= cfg.participants:
            raise InputError(f"participants = {cfg.participants}: all places are taken")
        participant = records.participant(label)
    print(f"participant {participant.label}, place {participant.place + 1} of {cfg.participants}")
    return participant
