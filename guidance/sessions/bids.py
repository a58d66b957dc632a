"""The records of a study with people: a folder as BIDS has it, in which no crash loses a finished game.

    dataset_description.json, README, .bidsignore    what this is, for people and for BIDS' tools
    manifest.json                        what the study rests on: configuration, seed, models, hash
    participants.tsv, participants.json  who takes part, and their places in the counterbalanced order
    trials.csv                           a row per rated game, the columns of `guidance.evaluate`'s
    sub-P01/sub-P01_consent.json         when P01 consented, and to which text
    sub-P01/beh/                         P01's games, see `guidance.sessions.recording`

`airhockey report runs=<folder>` reads it at any time. Every file is replaced whole and is on the disk before
the next one is touched, participants.tsv and the games are the truth, and all else is made from them. One process at a
time has the folder: its lock goes with the process, however that ends.
"""

import hashlib
import os
import re
import secrets
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from numbers import Integral
from pathlib import Path
from typing import Any

import pandas as pd

from airhockey_marl.experiment.files import fsync_dir, name_write_errors, remove_temporary_files
from airhockey_marl.experiment.run_folder import acquire_lock
from guidance.sessions.recording import (
    OBJECTIVE,
    RESULTS,
    UNSCORED,
    Columns,
    Game,
    Recording,
    games_in,
    load_json,
    rescue,
    save_json,
    save_text,
)
from guidance.simulated_users.ratings import RATINGS
from guidance.statistics.tests import CONDITIONS

TRIALS = ["user", "condition", "position", *OBJECTIVE, *RATINGS, *RESULTS[len(OBJECTIVE) :], "seed"]
NOT_LABELS = ("na", "nan", "null", "none")  # what programs that read tables take for a missing value
UNAMBIGUOUS = "23456789BCDFGHJKMNPQRSTVWXYZ"  # no 0 and O, no 1, I and L, and no vowels: no words
DESCRIPTION = {
    "Name": "Haptic guidance in air hockey: a study with people",
    "BIDSVersion": "1.10.0",
    "DatasetType": "raw",
    "GeneratedBy": [
        {"Name": "airhockey-haptics", "Description": "guidance.commands.lab, which also holds the study's protocol"}
    ],
}
PARTICIPANTS = {
    "participant_id": {"Description": "sub- and the person's label"},
    "place": {"Description": "row, from 0, of the counterbalanced orders in which conditions are played"},
}
IGNORED = "manifest.json\ntrials.csv\n*_consent.json\n*_desc-*_beh.*\n"
README = """Games of air hockey that people played under nine conditions of haptic guidance.

sub-*/beh/*_beh.tsv has a row per tick of a game, and the .json beside it says what each column is, what the game's
results were and how it was rated (1 to 7). acq- is the condition, run- its position in the person's order; run-0 is a
game without guidance from which the guidance learns, and is not evaluated. What is called desc-interrupted was broken
off and counts for nothing. trials.csv has a row per rated game. manifest.json says what the study rests on.
"""


class Records:
    """The records of one study with people; a context manager, which gives the folder free at its end.

    Attributes:
        folder: of the records.
        manifest: what the study rests on, as it was when its first person came, and how many have withdrawn.
        places: label -> place of everybody who takes part, in the order of places.
    """

    def __init__(self, folder: Path | str, facts: Mapping[str, Any]) -> None:
        """Begin a study, or go on with it.

        Args:
            folder: created if absent.
            facts: the study's manifest, see `guidance.study.provenance.manifest`; any JSON with `study_hash` and `seed`.

        Raises:
            ValueError: another process has the folder, or it holds another study or none; in one line.
            OSError: something could not be written; the message names it.
        """
        self.folder, self._on = Path(folder), None
        with name_write_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock: int | None = acquire_lock(self.folder, "records")
        try:
            self.manifest = self._same_study(facts)
            remove_temporary_files(self.folder)
            for name, content in (("README", README), (".bidsignore", IGNORED)):
                if not (self.folder / name).exists():
                    save_text(self.folder / name, content)
            for name, about in (("dataset_description.json", DESCRIPTION), ("participants.json", PARTICIPANTS)):
                if not (self.folder / name).exists():
                    save_json(self.folder / name, about)
            self.places = self._read_places()
            for label in self.places:
                rescue(self._person(label) / "beh")
            self._finished = self._finish_withdrawal()  # its second call may come now, and is right
            self.save_trials()
        except BaseException:
            self.close()
            raise

    def participant(self, label: str | None = None) -> "Participant":
        """Enrol a person, at the first place that is free, or go on with one.

        Args:
            label: letters and digits; None draws one for a new person that says nothing about them.

        Raises:
            ValueError: a label that is not one, that differs from somebody's only in capitals, or a game is on.
            OSError: something could not be written; the message names it.
        """
        self.require_no_game()
        self._finish_withdrawal()
        if label is None:
            label = self._new_label()
        check_label(label)
        for known in self.places:
            if known != label and known.lower() == label.lower():
                raise ValueError(f"participant = {label} must differ from {known} in more than capitals")
        if label not in self.places:
            if self._person(label).exists():
                raise ValueError(f"{self._person(label)} is there, but participants.tsv does not name {label}")
            free = next(place for place in range(len(self.places) + 1) if place not in self.places.values())
            self._save_places(self.places | {label: free})
        folder = self._person(label) / "beh"
        with name_write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            fsync_dir(folder.parent)
            fsync_dir(self.folder)
        return Participant(self, label)

    def withdraw(self, label: str, counted: bool = True) -> None:
        """Delete all that is known of a person; the next one who is enrolled gets their place.

        Only the number of those who have withdrawn is kept, and not even that if it is not `counted`: of somebody who
        never consented. What a crash leaves of it is finished when the folder is
        opened again. Reports and copies made of the records before are elsewhere, and not its business.

        Raises:
            ValueError: nobody has this label, or a game is on.
            OSError: something could not be deleted; the message names it. Another call goes on.
        """
        self.require_no_game()
        finished = self._finish_withdrawal() or self._finished
        self._finished = None
        if label not in self.places:
            if label == finished:
                return
            raise ValueError(f"withdraw = {label} must be one of those enrolled: {', '.join(self.places) or 'nobody'}")
        withdrawals = self.manifest["withdrawals"] + counted
        self._save_manifest(self.manifest | {"withdrawals": withdrawals, "withdrawing": label})
        self._finish_withdrawal()

    def trials(self) -> pd.DataFrame:
        """A row per rated game, the columns of trials.csv; conditions in the paper's order, people by their places.

        Raises:
            ValueError: a game's file is not as it was written; the message names it.
        """
        rows = []
        for label in self.places:
            for game in games_in(self._person(label) / "beh").values():
                if game.ratings is not None:
                    row = {"user": label, "condition": game.name, "position": game.position}
                    rows.append(row | game.results | game.ratings | {"seed": self.manifest["seed"]})
        conditions = [*CONDITIONS, *sorted({row["condition"] for row in rows} - set(CONDITIONS))]
        rows.sort(key=lambda row: conditions.index(row["condition"]))  # stable: people stay in the order of places
        return pd.DataFrame(rows, columns=TRIALS)

    def save_trials(self) -> None:
        """Write trials.csv from the games, unless it is as they have it.

        Raises:
            OSError: it could not be written.
        """
        path, content = self.folder / "trials.csv", self.trials().to_csv(index=False)
        if not path.exists() or path.read_text(encoding="utf-8") != content:
            save_text(path, content)

    def require_no_game(self) -> None:
        """Refuse what cannot be done while somebody plays.

        Raises:
            ValueError: a game is on.
        """
        if self._on is not None and self._on.on:
            raise ValueError(f"{self._on.stem.name}: this game is on")

    def set_on(self, recording: Recording) -> Recording:
        """Remember the game that is on: there is one device, hence one at a time."""
        self._on = recording
        return recording

    def close(self) -> None:
        """Give the folder free; a game that is on is interrupted."""
        if self._on is not None:
            self._on.close()
        if self._lock is not None:
            handle, self._lock = self._lock, None
            os.close(handle)  # the lock goes with it

    def __enter__(self) -> "Records":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _person(self, label: str) -> Path:
        return self.folder / f"sub-{label}"

    def _new_label(self) -> str:
        taken = {known.lower() for known in self.places}
        while True:
            label = "P" + "".join(secrets.choice(UNAMBIGUOUS) for _ in range(6))
            if label.lower() not in taken:
                return label

    def _same_study(self, facts: Mapping[str, Any]) -> dict[str, Any]:
        """The manifest of the folder's study, which these facts must be of; of a new one, written down first."""
        if absent := [key for key in ("study_hash", "seed") if key not in facts]:
            raise ValueError(f"the manifest of a study with people lacks {', '.join(absent)}")
        file = self.folder / "manifest.json"
        if not file.exists():
            if others := sorted(path.name for path in self.folder.iterdir() if not path.name.startswith(".")):
                raise ValueError(
                    f"records = {self.folder} holds {', '.join(others[:3])}, but no study: no manifest.json"
                )
            self._save_manifest({"participants": "people", **facts, "withdrawals": 0})
        known = load_json(file)
        if not isinstance(known.get("withdrawals"), int):
            raise ValueError(f"records = {self.folder} holds a study, but not one of the laboratory")
        for key in ("study_hash", "seed"):
            if known.get(key) != facts[key]:
                raise ValueError(
                    f"records = {self.folder} holds a study with {key} = {known.get(key)}, and this one has "
                    f"{facts[key]}: choose another folder, or what that study was begun with"
                )
        return known

    def _save_manifest(self, manifest: Mapping[str, Any]) -> None:
        save_json(self.folder / "manifest.json", manifest)
        self.manifest = dict(manifest)

    def _read_places(self) -> dict[str, int]:
        file = self.folder / "participants.tsv"
        if not file.exists():
            self._save_places({})
        header, *lines = file.read_text(encoding="utf-8").splitlines() or [""]
        places = {}
        for line in lines:
            found = re.fullmatch(r"sub-([A-Za-z0-9]{1,16})\t([0-9]+)", line)
            if not found or found[1] in places or int(found[2]) in places.values():
                raise ValueError(f"{file}: the line {line!r} must be sub-<label>, a tab and a place, each once")
            places[found[1]] = int(found[2])
        if header.split("\t") != list(PARTICIPANTS):
            raise ValueError(f"{file}: the columns {header!r} must be {', '.join(PARTICIPANTS)}")
        return places

    def _save_places(self, places: Mapping[str, int]) -> None:
        places = dict(sorted(places.items(), key=lambda item: item[1]))
        lines = ["\t".join(PARTICIPANTS), *(f"sub-{label}\t{place}" for label, place in places.items())]
        save_text(self.folder / "participants.tsv", "".join(f"{line}\n" for line in lines))
        self.places = places

    def _finish_withdrawal(self) -> str | None:
        """Do what is left of a withdrawal that has been decided; any part of it may have been done. Returns whose."""
        label = self.manifest.get("withdrawing")
        if label is None:
            return None
        with name_write_errors(self._person(label)):
            if self._person(label).exists():
                shutil.rmtree(self._person(label))
            fsync_dir(self.folder)
        self._save_places({known: place for known, place in self.places.items() if known != label})
        self.save_trials()
        self._save_manifest({key: value for key, value in self.manifest.items() if key != "withdrawing"})
        return label


class Participant:
    """One person in a study, see `Records.participant`.

    Attributes:
        label: their name here.
        place: their row, from 0, in the counterbalanced order.
        consent: its `time` (UTC), and the `text` that was shown and its `sha256`; None until it is given.
        games: their whole games by name, `UNSCORED` among them, in the order of positions.
    """

    def __init__(self, records: Records, label: str) -> None:
        self._records, self.label, self.place = records, label, records.places[label]
        self._folder = records.folder / f"sub-{label}"
        rescue(self._folder / "beh")
        consent = self._folder / f"sub-{label}_consent.json"
        self.consent = load_json(consent) if consent.exists() else None
        self.games: dict[str, Game] = games_in(self._folder / "beh")

    @property
    def interrupted(self) -> list[Path]:
        """The tables of games that were broken off, which count for nothing."""
        return sorted((self._folder / "beh").glob("*_desc-interrupted*_beh.tsv"))

    def give_consent(self, text: str) -> None:
        """Record that the person has consented to this text. The same consent may be given again, and changes nothing.

        Raises:
            ValueError: no text, or they have consented to another one.
            OSError: it could not be written.
        """
        self._require_here()
        if not text.strip():
            raise ValueError("consent: there must be a text to consent to")
        digest = hashlib.sha256(text.encode("utf-8")).hexdigest()
        if self.consent is not None:
            if self.consent["sha256"] != digest:
                raise ValueError(f"{self.label} has consented to another text, on {self.consent['time']}")
            return
        consent = {"time": datetime.now(UTC).isoformat(timespec="seconds"), "sha256": digest, "text": text}
        save_json(self._folder / f"sub-{self.label}_consent.json", consent)
        self.consent = consent

    def begin_game(
        self, name: str, position: int, columns: Columns, facts: Mapping[str, Any] | None = None
    ) -> Recording:
        """Begin a game; what is left of an earlier attempt at it is set aside.

        Args:
            name: of its condition, or `UNSCORED`.
            position: in the person's order, from 1; 0 for the unscored game, and only for it.
            columns: what is recorded each tick, see `guidance.sessions.recording.Columns`.
            facts: any JSON that is worth keeping with this game, such as the device and versions.

        Raises:
            ValueError: no consent, a name or position that is not one or is taken, or a game is on.
            OSError: something could not be written.
        """
        self._require_here()
        self._records.require_no_game()
        if self.consent is None:
            raise ValueError(f"{self.label} has not consented")
        if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
            raise ValueError(f"condition = {name!r} must be small letters, digits and underscores")
        whole = isinstance(position, Integral) and not isinstance(position, bool) and position >= 0
        if not whole or (position == 0) != (name == UNSCORED):
            raise ValueError(f"position = {position} of {name} must be a whole number from 1, and 0 of {UNSCORED}")
        rescue(self._folder / "beh")
        self.games.update(games_in(self._folder / "beh"))  # a game whose end failed halfway may be whole now
        short = name.replace("_", "")  # in BIDS an underscore separates
        for game in self.games.values():
            if game.name.replace("_", "") == short or game.position == position:
                raise ValueError(f"{self.label} has played {game.name} already, at position {game.position}")
        stem = self._folder / "beh" / f"sub-{self.label}_task-airhockey_acq-{short}_run-{int(position)}"
        return self._records.set_on(Recording.begin(stem, name, int(position), columns, facts or {}, self.games))

    def save_ratings(self, name: str, ratings: Mapping[str, int], interview: str = "") -> None:
        """Rate a game that was played; now it is in trials.csv. The same ratings may be saved again.

        Args:
            ratings: `guidance.simulated_users.ratings.RATINGS` by name, 1 to 7.
            interview: what the person said about it.

        Raises:
            ValueError: there is no such game, or what `guidance.sessions.recording.Game.rated` refuses.
            OSError: something could not be written.
        """
        self._require_here()
        if name not in self.games:
            raise ValueError(f"{self.label} has not played {name}, and cannot rate it")
        self.games[name] = self.games[name].rated(ratings, interview)
        self._records.save_trials()

    def _require_here(self) -> None:
        if self._records.places.get(self.label) != self.place:
            raise ValueError(f"{self.label} does not take part any more")


def check_label(label: str) -> None:
    """Refuse what is not the label of a person: 1 to 16 letters and digits, as BIDS has it.

    Raises:
        ValueError: it is not.
    """
    fine = isinstance(label, str) and re.fullmatch(r"[A-Za-z0-9]{1,16}", label)
    if not fine or label.lower() in NOT_LABELS:
        raise ValueError(f"participant = {label!r} must be 1 to 16 letters and digits, and not {', '.join(NOT_LABELS)}")
