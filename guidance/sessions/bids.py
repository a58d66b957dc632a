"""The records of a study with people: a folder laid out as BIDS, in which a crash loses no finished game.

    dataset_description.json, README, .bidsignore    description, for people and for tools of BIDS
    manifest.json                        configuration, seed, models and hash of the study
    participants.tsv, participants.json  the participants and their places in the counterbalanced orders
    trials.csv                           a row per rated game, with the columns of `guidance.evaluate`
    trials.json, trials_wide.csv, counts.csv, counts.json    see `guidance.statistics.codebook`
    sub-P01/sub-P01_consent.json         time of P01's consent, and its text
    sub-P01/beh/                         P01's games, see `guidance.sessions.recording`

`airhockey report runs=<folder>` reads it at any time. Files are replaced atomically and durably, one after the other;
everything can be derived from participants.tsv and the games. One process at a time holds the folder's lock, which ends
with the process.
"""

import re
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from filelock import FileLock

from airhockey_marl.experiment.config import flatten_settings
from airhockey_marl.experiment.files import fsync_dir, load_json, name_write_errors, remove_temporary_files
from airhockey_marl.experiment.run_folder import acquire_lock
from guidance.sessions.game import OBJECTIVE, RESULTS, load_games
from guidance.sessions.json_files import save_json, save_text
from guidance.sessions.participant import Participant, check_label
from guidance.sessions.recording import Recording, recover_games
from guidance.simulated_users.ratings import RATINGS
from guidance.statistics.codebook import tables_beside
from guidance.statistics.design import CONDITIONS, conditions_of, declared_conditions
from guidance.study.metrics import COUNTS

TRIALS = ["user", "condition", "position", *OBJECTIVE, *RATINGS, *RESULTS[len(OBJECTIVE) :], "seed"]
UNAMBIGUOUS = "23456789BCDFGHJKMNPQRSTVWXYZ"  # without 0 and O, 1, I and L, and vowels, which make words
FILES = Path(__file__).parent / "bids_files"  # that are the same in every study
PARTICIPANTS_COLUMNS = ["participant_id", "place"]


def shorten(value: Any, most: int = 60) -> str:
    """A value in one line of at most so many characters."""
    text = " ".join(str(value).split())
    return text if len(text) <= most else f"{text[: most - 3]}..."


class Records:
    """The records of one study with people; a context manager that holds a lock on their folder.

    Attributes:
        folder: of the records.
        manifest: configuration, seed and models of the study when it began, and the number of withdrawals.
        places: label -> place in the counterbalanced orders, ordered by place.
    """

    def __init__(self, folder: Path | str, manifest: Mapping[str, Any]) -> None:
        """Begin a study, or resume it.

        Args:
            folder: created if absent.
            manifest: of the study, see `guidance.study.setup.manifest`; any JSON with `study_hash` and `seed`.

        Raises:
            ValueError: another process has the folder, or the folder holds another study or none; in one line.
            OSError: a file could not be written; the message names it.
        """
        self.folder, self._active, self._gone = Path(folder), None, set()
        with name_write_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock: FileLock | None = acquire_lock(self.folder, "records")
        try:
            self.manifest = self._require_same_study(manifest)
            remove_temporary_files(self.folder)
            for name in ("README", ".bidsignore", "dataset_description.json", "participants.json"):
                if not (self.folder / name).exists():
                    save_text(self.folder / name, (FILES / name.lstrip(".")).read_text(encoding="utf-8"))
            self.places = self._read_places()
            for label in self.places:
                recover_games(self._person(label) / "beh")
            gone = [self._finish_withdrawal()]
            for label in [label for label in self.places if not self._took_part(label)]:
                self.withdraw(label, counted=False)  # a session that was killed before the consent
                gone.append(label)
            self._gone = {label for label in gone if label}  # whose `withdraw` may be repeated
            self.save_trials()
        except BaseException:
            self.close()
            raise

    def participant(self, label: str | None = None) -> "Participant":
        """Enroll a person at the first free place, or resume with an enrolled one.

        Args:
            label: letters and digits; None draws a random one for a new person.

        Raises:
            ValueError: an invalid label, one that differs from an existing one only in capitals, or a game is running.
            OSError: a file could not be written; the message names it.
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
        """Delete all data of a person; the next new person gets their place.

        The number of withdrawals is kept, unless not `counted`, for a person who never consented. After a crash, the
        deletion is finished when the folder is opened again. Existing reports and copies are not affected.

        Raises:
            ValueError: no such label, or a game is running.
            OSError: a file could not be deleted; the message names it. Another call continues.
        """
        self.require_no_game()
        gone = self._gone | {self._finish_withdrawal()}
        self._gone = set()
        if label not in self.places:
            if label in gone:
                return
            raise ValueError(f"withdraw = {label} must be one of those enrolled: {', '.join(self.places) or 'nobody'}")
        withdrawals = self.manifest["withdrawals"] + counted
        self._save_manifest(self.manifest | {"withdrawals": withdrawals, "withdrawing": label})
        self._finish_withdrawal()

    def trials(self) -> pd.DataFrame:
        """A row per rated game with the columns of trials.csv, by condition in the paper's order, then by place."""
        return self._rated_games()[TRIALS]

    def _rated_games(self) -> pd.DataFrame:
        """`trials` and the columns `COUNTS`."""
        rows = []
        for label in self.places:
            for game in load_games(self._person(label) / "beh").values():
                if game.ratings is not None:
                    row = {"user": label, "condition": game.name, "position": game.position}
                    rows.append(row | game.results | game.ratings | {"seed": self.manifest["seed"]} | game.counts)
        conditions = [*CONDITIONS, *sorted({row["condition"] for row in rows} - set(CONDITIONS))]
        rows.sort(key=lambda row: conditions.index(row["condition"]))  # stable: keeps the order of places
        return pd.DataFrame(rows, columns=[*TRIALS, *COUNTS]).astype(dict.fromkeys(COUNTS, "Int64"))

    def save_trials(self) -> None:
        """Write trials.csv and the tables beside it from the games, those that differ."""
        games = self._rated_games()
        trials, counts = games[TRIALS], games[["user", "condition", *COUNTS]]
        conditions = conditions_of(trials, declared_conditions(self.manifest.get("conditions", ())))
        tables = {"trials.csv": trials.to_csv(index=False)}
        for name, content in (tables | tables_beside(trials, counts, conditions, self.manifest)).items():
            path = self.folder / name
            if not path.exists() or path.read_text(encoding="utf-8") != content:
                save_text(path, content)

    def require_no_game(self) -> None:
        """Raise a ValueError while a game is running."""
        if self._active is not None and self._active.is_open:
            raise ValueError(f"{self._active.stem.name}: this game is running")

    def set_active(self, recording: Recording) -> Recording:
        """Remember the running game; with one device there is at most one."""
        self._active = recording
        return recording

    def close(self) -> None:
        """Release the folder; a running game is interrupted."""
        if self._active is not None:
            self._active.close()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> "Records":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _person(self, label: str) -> Path:
        return self.folder / f"sub-{label}"

    def _took_part(self, label: str) -> bool:
        """Whether there is a consent of a person, or a game."""
        return any(file.is_file() for file in self._person(label).rglob("*"))

    def _new_label(self) -> str:
        taken = {known.lower() for known in self.places}
        while True:
            label = "P" + "".join(secrets.choice(UNAMBIGUOUS) for _ in range(6))
            if label.lower() not in taken:
                return label

    def _require_same_study(self, manifest: Mapping[str, Any]) -> dict[str, Any]:
        """The manifest of the folder's study, which must be the same; that of a new study is written first."""
        if absent := [key for key in ("study_hash", "seed") if key not in manifest]:
            raise ValueError(f"the manifest of a study with people lacks {', '.join(absent)}")
        file = self.folder / "manifest.json"
        if not file.exists():
            if others := sorted(path.name for path in self.folder.iterdir() if not path.name.startswith(".")):
                raise ValueError(
                    f"records = {self.folder} holds {', '.join(others[:3])}, but no study: no manifest.json"
                )
            self._save_manifest({"participants": "people", **manifest, "withdrawals": 0})
        known = load_json(file)
        if not isinstance(known.get("withdrawals"), int):
            raise ValueError(f"records = {self.folder} holds a study, but not one of the laboratory")
        identity = "study_hash", "seed"
        if any(known.get(key) != manifest[key] for key in identity):
            before, now = (
                flatten_settings(each.get("config", {})) | {key: each.get(key) for key in identity}
                for each in (known, manifest)
            )
            changed = [key for key in before if before[key] != now.get(key)]
            changed = [key for key in changed if key != "study_hash"]
            values = [f"{key} = {shorten(before[key])} and not {shorten(now.get(key))}" for key in changed[:3]]
            values += [f"{len(changed) - 3} other keys"] if len(changed) > 3 else []
            raise ValueError(
                f"records = {self.folder} holds a study with "
                f"{', '.join(values) or f'study_hash = {before[identity[0]]} and not {now[identity[0]]}'}: "
                "choose another folder, or the configuration of that study"
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
            match = re.fullmatch(r"sub-([A-Za-z0-9]{1,16})\t([0-9]+)", line)
            if not match or match[1] in places or int(match[2]) in places.values():
                raise ValueError(f"{file}: the line {line!r} must be sub-<label>, a tab and a place, each once")
            places[match[1]] = int(match[2])
        if header.split("\t") != PARTICIPANTS_COLUMNS:
            raise ValueError(f"{file}: the columns {header!r} must be {', '.join(PARTICIPANTS_COLUMNS)}")
        return places

    def _save_places(self, places: Mapping[str, int]) -> None:
        places = dict(sorted(places.items(), key=lambda item: item[1]))
        lines = ["\t".join(PARTICIPANTS_COLUMNS), *(f"sub-{label}\t{place}" for label, place in places.items())]
        save_text(self.folder / "participants.tsv", "".join(f"{line}\n" for line in lines))
        self.places = places

    def _finish_withdrawal(self) -> str | None:
        """Finish a withdrawal that a crash may have interrupted anywhere; returns the label, or None without one."""
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
