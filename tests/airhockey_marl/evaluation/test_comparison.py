"""The comparison of algorithms: from run folders to the table, the csv and the figure; invalid runs."""

import json
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf

from airhockey_marl.evaluation import comparison as compare
from airhockey_marl.experiment.command import run as start_command
from airhockey_marl.experiment.files import find_files, save_tensors
from airhockey_marl.league.league import League
from airhockey_marl.players.networks import GaussianPolicy
from tests.pictures import faults

GENERATIONS, STEPS = 4, 1000


def make_run(folder: Path, algorithm: str, seed: int, hidden: tuple[int, ...] = (8,), **settings) -> Path:
    """The files of a finished training run with untrained policies."""
    league = League(GaussianPolicy(hidden))
    for generation in range(GENERATIONS + 1):
        torch.manual_seed(100 * seed + generation)
        league.add(GaussianPolicy(hidden))
    league.save(folder / "league.safetensors")
    (folder / "card.json").write_text(json.dumps({"seconds": 8.0, "seed": seed}))
    cfg = {
        "algorithm": {"name": algorithm.lower(), "lr": 0.1},
        "env": {"frame_skip": 25},  # half a second: few are soon played
        "steps_per_generation": STEPS,
        "seed": seed,
        **settings,
    }
    (folder / ".hydra").mkdir()
    OmegaConf.save(OmegaConf.create(cfg), folder / ".hydra" / "config.yaml")
    return folder


@pytest.fixture
def sweep(tmp_path) -> Path:
    """Two seeds of one algorithm and one of another, whose model is larger, as a sweep leaves them."""
    make_run(tmp_path / "sweep" / "0", "TRPO", 0)
    make_run(tmp_path / "sweep" / "1", "TRPO", 1)
    make_run(tmp_path / "sweep" / "2", "SAC", 0, hidden=(8, 8))
    return tmp_path / "sweep"


def run_command(monkeypatch, tmp_path: Path, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["compare", f"hydra.run.dir={tmp_path}/run", "rounds=4", *arguments])
    start_command("airhockey_marl.commands.compare")


def complaint(monkeypatch, capsys, tmp_path: Path, *arguments: str) -> str:
    """What the command says when it must refuse: one line, exit code 2, nothing written."""
    with pytest.raises(SystemExit) as stopped:
        run_command(monkeypatch, tmp_path, *arguments)
    shown = capsys.readouterr().err
    assert stopped.value.code == 2
    assert shown.startswith("error: ") and shown.count("\n") == 1
    assert not list((tmp_path / "run").glob("comparison*"))
    return shown


def test_command_writes_all_results(monkeypatch, capsys, sweep, tmp_path):
    run_command(monkeypatch, tmp_path, f"runs={sweep}")
    results = pd.read_csv(tmp_path / "run" / "comparison.csv")
    assert len(results) == 3 * 5 * 3 + 2 * 3  # five generations against three each; three pairs, from both sides
    assert (results[["won", "lost", "undecided"]].sum(axis=1) == 4).all()
    assert set(results["opponent"]) == {"defender", "striker", "generation 0", "TRPO", "SAC"}
    assert (results["steps"] == STEPS * results["generation"]).all() and (results["seconds"] == 8.0).all()
    assert (tmp_path / "run" / "comparison.png").stat().st_size > 1000

    across = results[results["opponent_seed"].notna()].set_index(["algorithm", "seed", "opponent", "opponent_seed"])
    assert (across["generation"] == GENERATIONS).all()
    there, back = across.loc[("TRPO", 1, "SAC", 0)], across.loc[("SAC", 0, "TRPO", 1)]
    assert (there["won"], there["lost"]) == (back["lost"], back["won"])

    lines = capsys.readouterr().out.splitlines()[1:]
    assert " ".join(lines[0].split()) == "win rate against seeds defender striker generation 0 SAC TRPO frames/s"
    assert lines[1].split()[:2] == ["SAC", "1"] and lines[2].split()[:2] == ["TRPO", "2"]
    assert lines[1].endswith("500") and lines[2].endswith("500 ± 0")


def test_comparison_is_reproducible(sweep):
    runs = [compare.read_run(file.parent) for file in find_files([sweep], compare.LEAGUE_FILE)]
    first, second, other = (compare.compare(runs[:2], 4, seed) for seed in (1, 1, 2))
    pd.testing.assert_frame_equal(first, second)
    assert not first.equals(other)


def test_match_has_the_given_number_of_rounds():
    policy = GaussianPolicy([8])
    for rounds in (1, 100, 150):
        [counts] = compare.play(policy, policy, 1, rounds, 0, {"frame_skip": 25})
        assert sum(counts) == rounds


def rows(algorithm: str, seed: int, opponent: str, won: int, lost: int, generation: int = 2) -> dict:
    return {
        "algorithm": algorithm,
        "seed": seed,
        "generation": generation,
        "steps": generation * STEPS,
        "opponent": opponent,
        "won": won,
        "lost": lost,
        "undecided": 10,
        "seconds": 4.0 * (1 + seed),
    }


def test_table_has_mean_and_sd_over_the_seeds_of_the_last_generations():
    results = pd.DataFrame(
        [
            rows("PPO", 0, "striker", 9, 1, generation=1),  # an earlier generation
            rows("PPO", 0, "striker", 2, 8),
            rows("PPO", 1, "striker", 4, 6),
            rows("PPO", 0, "SAC", 1, 1),  # two seeds of the other
            rows("PPO", 0, "SAC", 8, 0),
            rows("PPO", 0, "PPO", 8, 0),  # another seed of the same
            rows("SAC", 0, "striker", 0, 0),  # all undecided
        ]
    )
    head, ppo, sac = (line.rsplit(maxsplit=0)[0] for line in compare.screen_table(results).splitlines())
    assert len(head) == len(ppo) == len(sac)
    assert "0.30 ± 0.14" in ppo and "0.90" in ppo and "375 ± 177" in ppo
    assert sac.split() == ["SAC", "1", "–", "–", "–", "–", "–", "500"]


def test_figure_has_a_line_per_seed_and_the_mean_of_each_algorithm():
    opponents = ("defender", "striker", "generation 0")
    results = pd.DataFrame(
        [
            rows(algorithm, seed, opponent, 5 + seed, 5, generation)
            for algorithm in ("TRPO", "SAC")
            for seed in (0, 1, 2)
            for generation in (0, 2)
            for opponent in opponents
        ]
    )
    figure = compare.comparison_figure(results.assign(steps=results["steps"] // 100))  # of short trainings
    assert not faults(figure)
    panels = compare.comparison_figure(results).axes
    assert [axes.get_title() for axes in panels] == [f"against {opponent}" for opponent in opponents]
    lines = [line for line in panels[0].lines if len(line.get_xdata()) == 2 and line.get_linestyle() == "-"]
    assert len(lines) == 2 * (3 + 1) and len({line.get_color() for line in lines}) == 2
    mean = (5 / 10 + 6 / 11 + 7 / 12) / 3
    assert lines[3].get_ydata()[-1] == pytest.approx(mean) and lines[3].get_xdata()[-1] == 2 * STEPS / 1e6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["runs=nowhere"], "runs = nowhere: there is no league.safetensors at or below it"),
        ([], "runs must be chosen"),
        (["runs={sweep}", "rounds=0"], "rounds = 0 must be a whole number of at least 1"),
        (["runs={sweep}", "seed=-1"], "seed = -1"),
        (["runs={sweep}", "rnds=3"], "rnds"),
    ],
)
def test_wrong_input_is_named(monkeypatch, capsys, sweep, tmp_path, arguments, message):
    filled = [argument.format(sweep=sweep) for argument in arguments]
    assert message in complaint(monkeypatch, capsys, tmp_path, *filled)


def test_unreadable_and_incomparable_runs_are_named(monkeypatch, capsys, sweep, tmp_path):
    def refused() -> str:
        return complaint(monkeypatch, capsys, tmp_path, f"runs={sweep}")

    make_run(sweep / "3", "SAC", 0)
    assert "SAC with seed 0 twice" in refused()
    OmegaConf.save({"seed": 3}, sweep / "3" / ".hydra" / "config.yaml")
    assert "3 has no algorithm.name, steps_per_generation, env.frame_skip" in refused()
    (sweep / "3" / ".hydra" / "config.yaml").write_text("a: [")
    assert "3/.hydra/config.yaml is no yaml" in refused()
    (sweep / "3" / "card.json").unlink()
    assert "3 is not a finished training run: it has no card.json" in refused()
    make_run(sweep / "4", "PPO", 0, env={"frame_skip": 1})
    for name in ("league.safetensors", "card.json"):
        (sweep / "3" / name).unlink(missing_ok=True)
    assert "runs: env.frame_skip = 25" in refused()
    shutil.rmtree(sweep / "4")
    make_run(sweep / "4", "PPO", 0, env={"frame_skip": 25, "arm": {"mass": -1.0}})
    assert "env.arm.mass = -1.0 must be a finite number" in refused()
    shutil.rmtree(sweep / "4")
    make_run(sweep / "4", "PPO", 0, env={"frame_skip": 25, "arm": {}})
    assert "runs: env.arm = None" in refused()
    save_tensors(sweep / "4" / "league.safetensors", {"x": torch.zeros(1)})
    assert "league.safetensors: has no sizes of hidden layers (hidden)" in refused()
