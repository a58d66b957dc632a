"""Collect the paper's data set: what simulated people do in games without guidance, tick by tick (section 3.2.3).

    airhockey collect                         nine training users, 40 K ticks each
    airhockey collect people=study            20 people of a study instead
    airhockey collect +preset=smoke           seconds, to see that it runs

Writes into its run folder:

    demonstrations/          memory-mapped TensorDict (users, games, ticks): observation (12), action (2), user, game
    demonstrations.parquet   the same, a row per tick, a name and a unit for each column, a row group per user
    people.csv               a row per user: archetype, skill, and every other parameter of the simulated person
    card.json                what all this is, the SHA-256 of each file, and how to open it; written last

`guidance.user_model.dataset.load` reads the folder back. The same seed gives the same bytes in every file but the card.
"""

import time
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import sha256, write_json, write_text
from airhockey_marl.experiment.progress import ProgressBar
from airhockey_marl.experiment.run_folder import card_facts, output_folder


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "participants", "demonstrations.games", "demonstrations.ticks")
    require_counts(cfg, "opponent", least=0)
    if cfg.people not in ("training", "study"):
        raise InputError(f"people = {cfg.people} must be training or study")


def main(cfg: DictConfig) -> None:
    from guidance.simulated_users import load_population, sample_people, training_people
    from guidance.study.demonstrations import collect_demonstrations
    from guidance.study.setup import load_play_setup
    from guidance.user_model import dataset

    folder, start = output_folder(cfg), time.perf_counter()
    with report_input_errors():
        setup = load_play_setup(cfg)
        if (folder / dataset.TENSORS).exists():
            raise InputError(
                f"hydra.run.dir = {folder} must be a folder without {dataset.TENSORS}/: data are not replaced"
            )
        population = load_population(cfg.users)
        draw = training_people if cfg.people == "training" else partial(sample_people, cfg.participants)
        people = draw(cfg.seed, population)
    progress, table = ProgressBar(), setup.table
    play = partial(progress, f"{len(people)} people play")
    data = collect_demonstrations(people, setup, **cfg.demonstrations, seed=cfg.seed, progress=play)
    progress.close()
    rows = dataset.people_table(people, list(population["archetypes"]))
    dataset.write_tensors(folder / dataset.TENSORS, data)
    dataset.write_rows(folder / dataset.ROWS, data, rows["archetype"], table)
    write_text(folder / dataset.PEOPLE, rows.to_csv(index=False))
    users = rows[["user", "archetype"]].join(dataset.summary(data, table).round(4)).to_dict("records")
    sizes = dict(zip(("users", "games", "ticks"), data.action.shape[:3], strict=True))
    content = card(cfg, folder, sizes | {"tick_s": table.tick}, users)
    write_json(folder / dataset.CARD, content | card_facts(cfg, time.perf_counter() - start))
    print(f"{data.action.shape[:3].numel()} ticks of {len(people)} simulated people: {folder}")


def card(cfg: DictConfig, folder: Path, sizes: dict, users: list[dict]) -> dict:
    """The data card: what the files hold, where they come from, how to open them."""
    from guidance.user_model.dataset import ABOUT, COLUMNS, FRAME, PEOPLE, ROWS, TENSORS

    files = [*sorted((folder / TENSORS).iterdir()), folder / ROWS, folder / PEOPLE]
    return {
        "data": ABOUT,
        "opponent_generation": cfg.opponent,
        "opponents_sha256": sha256(cfg.models.opponents),
        **sizes,
        "open": [
            f"import pandas; rows = pandas.read_parquet('{ROWS}')",
            f"from tensordict import TensorDict; tensors = TensorDict.load_memmap('{TENSORS}')",
        ],
        "tensors": "observation holds the columns own_x to puck_vy, action action_x and action_y",
        "frame": FRAME,
        "columns": {name: {"unit": unit, "meaning": what} for name, (_, unit, what) in COLUMNS.items()},
        "sha256": {str(file.relative_to(folder)): sha256(file) for file in files},
        "on_each_user": users,
    }
