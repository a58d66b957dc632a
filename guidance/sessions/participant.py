"""One person of a study with people: consent, games and ratings."""

import hashlib
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from airhockey_marl.experiment.files import load_json
from guidance.sessions.game import Game, load_games
from guidance.sessions.json_files import save_json
from guidance.sessions.recording import Columns, Recording, recover_games

NOT_LABELS = ("na", "nan", "null", "none")  # which programs read as a missing value


class Study(Protocol):
    """The part of `guidance.sessions.bids.Records` that a participant uses."""

    folder: Path
    places: dict[str, int]

    def require_no_game(self) -> None: ...

    def set_active(self, recording: Recording) -> Recording: ...

    def save_trials(self) -> None: ...


class Participant:
    """One person of a study, see `guidance.sessions.bids.Records.participant`.

    Attributes:
        label: pseudonym of the person.
        place: row, from 0, in the counterbalanced orders.
        consent: `time` (UTC), `text` and its `sha256`; None before the consent.
        games: name -> complete game, including `UNSCORED`, ordered by position.
    """

    def __init__(self, study: Study, label: str) -> None:
        self._study, self.label, self.place = study, label, study.places[label]
        self._folder = study.folder / f"sub-{label}"
        recover_games(self._folder / "beh")
        consent = self._folder / f"sub-{label}_consent.json"
        self.consent = load_json(consent) if consent.exists() else None
        self.games: dict[str, Game] = load_games(self._folder / "beh")

    def give_consent(self, text: str) -> None:
        """Record the person's consent to this text; repeating it changes nothing.

        Raises:
            ValueError: no text, or the person has consented to another one.
            OSError: it could not be written.
        """
        self._require_enrolled()
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
        """Begin the recording of a game; the files of an interrupted attempt are kept under other names.

        Args:
            name: of its condition, or `UNSCORED`.
            position: in the person's order, from 1; 0 for the unscored game, and only for it.
            columns: of the table, see `guidance.sessions.recording.Columns`.
            facts: any JSON to keep with the game, such as the device.

        Raises:
            ValueError: no consent, an invalid or repeated name or position, or another game is running.
            OSError: a file could not be written.
        """
        self._require_enrolled()
        self._study.require_no_game()
        if self.consent is None:
            raise ValueError(f"{self.label} has not consented")
        if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
            raise ValueError(f"condition = {name!r} must be small letters, digits and underscores")
        recover_games(self._folder / "beh")
        self.games.update(load_games(self._folder / "beh"))  # a game whose end failed halfway may now be complete
        short = name.replace("_", "")  # underscores separate the parts of a name in BIDS
        for game in self.games.values():
            if game.name.replace("_", "") == short or game.position == position:
                raise ValueError(f"{self.label} has played {game.name} already, at position {game.position}")
        stem = self._folder / "beh" / f"sub-{self.label}_task-airhockey_acq-{short}_run-{position}"
        return self._study.set_active(Recording(stem, name, position, columns, facts or {}, self.games))

    def save_ratings(self, name: str, ratings: Mapping[str, int], interview: str = "") -> None:
        """Save the ratings of a complete game, and add it to trials.csv. The same ratings may be saved again.

        Args:
            ratings: name in `guidance.simulated_users.ratings.RATINGS` -> 1 to 7.
            interview: the experimenter's note on what the person said about the game.
        """
        self._require_enrolled()
        if name not in self.games:
            raise ValueError(f"{self.label} has not played {name}, and cannot rate it")
        self.games[name] = self.games[name].rate(ratings, interview)
        self._study.save_trials()

    def _require_enrolled(self) -> None:
        if self._study.places.get(self.label) != self.place:
            raise ValueError(f"{self.label} does not take part any more")


def check_label(label: str) -> None:
    """Raise a ValueError unless a label is 1 to 16 letters and digits, as in BIDS, and not a missing value."""
    is_valid = isinstance(label, str) and re.fullmatch(r"[A-Za-z0-9]{1,16}", label)
    if not is_valid or label.lower() in NOT_LABELS:
        raise ValueError(f"participant = {label!r} must be 1 to 16 letters and digits, and not {', '.join(NOT_LABELS)}")
