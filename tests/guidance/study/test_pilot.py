"""The pilot: its candidates, its objective, its search, and its games."""

import numpy as np
import pandas as pd
import pytest

from guidance.forces.conditions import ADAPTED, OPTIMAL
from guidance.study.calibration.candidates import Candidate, Cell, make_candidates, objective
from guidance.study.calibration.pilot import steady_cells
from guidance.study.calibration.search import Tables, successive_halving

AHEAD = {"now": 0.0, "later": 0.2}
SEARCH = {
    "league": ["one"],
    "predictor": list(AHEAD),
    "reading": ["printed", "physics", "consistent"],
    "lookahead": [0.0, 0.1, 0.2],
    "stiffness": [50.0],
    "limit": [3.0],
}
FIELDS = [*Candidate._fields]


def errors(now: float, later: float) -> pd.DataFrame:
    rows = [("now", seconds, now * seconds) for seconds in (0.0, 0.1, 0.2)] + [("later", 0.2, later)]
    columns = ["predictor", "ahead_s", "rmse"]
    return pd.concat([pd.DataFrame(rows, columns=columns).assign(reading=name) for name in ("printed", "physics")])


def test_settings_without_a_difference_to_the_force_are_one_cell():
    ahead = {"later": 0.2}
    printed, physics = (
        Candidate("one", "later", reading, 0.1, 50.0, 3.0).cells(ahead) for reading in ("printed", "physics")
    )
    assert printed[0] == Cell(OPTIMAL, "one", "printed", 0.1, 50.0, 3.0) != physics[0]
    assert printed[1] == physics[1] == Cell(ADAPTED, "later", "printed", 0.0, 50.0, 3.0)  # the state is not moved
    consistent = Candidate("one", "later", "consistent", 0.1, 50.0, 3.0).cells(ahead)
    assert consistent[1] == Cell(ADAPTED, "later", "consistent", 0.0, 50.0, 3.0)  # but the hand is, by .2 s
    beyond = Candidate("one", "later", "physics", 0.3, 50.0, 3.0).cells(ahead)
    assert beyond[1] == Cell(ADAPTED, "later", "physics", 0.3, 50.0, 3.0)


@pytest.mark.parametrize(("error", "best"), [(0.1, "later"), (1.0, "now")])
def test_only_the_predictor_with_the_smaller_error_at_its_horizon_is_a_candidate(error, best):
    candidates = make_candidates(SEARCH, errors(1.0, error), AHEAD, 0.15)
    at_two = {c.predictor for c in candidates if max(c.lookahead, AHEAD[c.predictor]) == 0.2}
    assert at_two == {best} and all(max(c.lookahead, AHEAD[c.predictor]) >= 0.15 for c in candidates)
    assert len({c.cells(AHEAD) for c in candidates}) == len(candidates)


def test_the_objective_is_the_mean_of_both_over_people():
    candidate = Candidate("one", "later", "printed", 0.0, 50.0, 3.0)
    optimal, user = candidate.cells(AHEAD)
    rows = [(*optimal, person, 0.5 + 0.1 * person) for person in range(4)]
    rows += [(*user, person, [0.2, 0.4, np.nan, 0.6][person]) for person in range(4)]
    table = objective([candidate], pd.DataFrame(rows, columns=[*Cell._fields, "person", "win_rate"]), AHEAD)
    both = np.array([0.35, 0.5, 0.7])
    assert table.loc[0, ["objective", "se"]].to_list() == pytest.approx([both.mean(), both.std(ddof=1) / np.sqrt(3)])
    assert table.loc[0, "oahg"] == pytest.approx(0.65) and table.loc[0, "games"] == 6


class KnownPilot:
    """A pilot whose win rates are known but for noise; it stops after so many batches."""

    ahead = AHEAD

    def __init__(self, batches: float = np.inf) -> None:
        self.batches = batches

    def unscored_games(self, persons):
        return []

    def adapted(self, demonstrations):
        return {}

    def play(self, cells, persons, adapted):
        self.batches -= 1
        if self.batches < 0:
            raise KeyboardInterrupt
        rows = []
        for cell in cells:
            mean = 0.3 + 0.001 * cell.stiffness - 0.5 * cell.lookahead
            for person in persons:
                rng = np.random.default_rng([person, round(cell.stiffness), round(100 * cell.lookahead)])
                rows.append((*cell, person, mean + rng.normal(0, 0.1)))
        return pd.DataFrame(rows, columns=[*Cell._fields, "person", "win_rate"])


def search(folder, pilot):
    folder.mkdir(exist_ok=True)
    choices = SEARCH | {"stiffness": [20.0, 50.0, 100.0, 200.0], "reading": ["printed"]}
    candidates = make_candidates(choices, errors(1.0, 0.1), AHEAD, 0.15)
    return successive_halving(pilot, candidates, [8, 8, 40], [6, 2], 24, Tables(folder), lambda name, share: None)


def test_the_search_finds_the_best_and_counts_only_new_people_in_the_end(tmp_path):
    standings = search(tmp_path, KnownPilot())
    rounds = [standings[standings["round"] == number] for number in (1, 2, 3)]
    assert [len(part) for part in rounds] == [8 + 4, 6, 2]
    assert [part["games"].iloc[0] for part in rounds] == [16, 32, 80]
    best = rounds[-1].iloc[0]
    assert best["stiffness"] == 200.0 and best["lookahead"] == 0.0
    assert abs(best["oahg"] - 0.5) < 3 * 0.1 / np.sqrt(40)


def test_a_stopped_search_ends_like_one_never_stopped(tmp_path):
    whole = search(tmp_path / "whole", KnownPilot())
    pilot = KnownPilot(batches=3)
    with pytest.raises(KeyboardInterrupt):
        search(tmp_path / "stopped", pilot)
    pd.testing.assert_frame_equal(search(tmp_path / "stopped", KnownPilot()), whole)
    games = [(tmp_path / name / "games.csv").read_bytes() for name in ("whole", "stopped")]
    assert games[0] == games[1]


def test_a_cell_is_steady_if_enough_people_are():
    cells = [Cell(ADAPTED, "later", "printed", 0.0, stiffness, 3.0) for stiffness in (50.0, 200.0)]
    wander = {50.0: [0.001] * 19 + [0.1], 200.0: [0.001] * 18 + [0.1] * 2}
    rows = [(*cell, person, value) for cell in cells for person, value in enumerate(wander[cell.stiffness])]
    table = pd.DataFrame(rows, columns=[*Cell._fields, "person", "wander"])
    assert steady_cells(table, 0.01, 0.95) == {cells[0]}
    assert steady_cells(table, 0.01, 0.9) == set(cells)
