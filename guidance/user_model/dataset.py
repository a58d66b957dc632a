"""A data set of demonstrations on disk: a memory-mapped TensorDict, and the same rows as Parquet; no pickles."""

import json
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from tensordict import TensorDict

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.files import atomic_write, sha256
from guidance.simulated_users.arm import HAND_REACH
from guidance.user_model.data import Demonstrations, hand_speed, round_starts

TENSORS, ROWS, PEOPLE, CARD = "demonstrations", "demonstrations.parquet", "people.csv", "card.json"
ABOUT = "air hockey without guidance, played by SIMULATED people: no human being took part"
FRAME = (
    "from the table's center, x toward the opponent, y to the user's left; an action is where the hand is over its "
    f"reach of {HAND_REACH} m, 0 sends the paddle to the middle of its side, +-1 to the ends; a round begins where "
    "both paddles are at rest in the middle of their sides and puck_x is 0"
)
BODIES = {"own": "the user's paddle", "other": "the opponent's paddle", "puck": "the puck"}
AXES = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}
COLUMNS = {  # name: (type, unit, meaning)
    "user": (pa.int32(), "1", "number of the person, from 0, as in people.csv"),
    "game": (pa.int32(), "1", "number of the user's game, from 0"),
    "tick": (pa.int32(), "1", "number of the tick in the game, from 0; games go on from round to round"),
    "time_s": (pa.float64(), "s", "from the beginning of the game to the beginning of the tick"),
    "archetype": (pa.string(), "1", "the playstyle around which the person was drawn"),
    **{
        f"{body}_{axis}": (pa.float32(), unit, f"{axis} of {name} at the beginning of the tick")
        for body, name in BODIES.items()
        for axis, unit in AXES.items()
    },
    **{f"action_{axis}": (pa.float32(), "1", f"{axis} of the hand at the end of the tick") for axis in "xy"},
}


def people_table(people: np.ndarray, archetypes: list[str]) -> pd.DataFrame:
    """A row per person of `people` (users,): parameters in SI units, an array one column per element."""
    columns = {"user": np.arange(len(people))}
    for name in people.dtype.names or ():
        for place in np.ndindex(people[name].shape[1:]):
            columns["_".join([name, *map(str, place)])] = people[name][:, *place]
    return pd.DataFrame({**columns, "archetype": [archetypes[number] for number in people["archetype"]]})


def write_tensors(path: Path, data: Demonstrations) -> None:
    """Write the TensorDict atomically, as a folder of meta.json and raw .memmap files."""
    batch = data.action.shape[:3]
    user, game, _ = torch.meshgrid(*map(torch.arange, batch), indexing="ij")
    tensors = TensorDict({"observation": data.observation, "action": data.action, "user": user, "game": game}, batch)
    with TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as temporary:
        complete = Path(temporary) / path.name
        tensors.memmap(complete)
        for file in complete.iterdir():
            with file.open("rb") as handle:
                os.fsync(handle.fileno())
            file.chmod(0o444)  # so that changing a mapped tensor in place changes memory only
        complete.rename(path)


def write_rows(path: Path, data: Demonstrations, archetypes: pd.Series, table: TableSpec) -> None:
    """Write the Parquet file with the columns `COLUMNS`: a row per tick, ordered by user, game and tick."""
    metadata = {name: {"unit": unit, "meaning": meaning} for name, (_, unit, meaning) in COLUMNS.items()}
    fields = [pa.field(name, kind, metadata=metadata[name]) for name, (kind, *_) in COLUMNS.items()]
    schema = pa.schema(fields, metadata={"data": ABOUT, "frame": FRAME})
    game, tick = np.indices(data.action.shape[1:3]).reshape(2, -1)
    options = {"compression": "zstd", "use_dictionary": ["user", "game", "archetype"]}  # larger with more
    with atomic_write(path) as temporary, pq.ParquetWriter(temporary, schema, **options) as writer:
        for user, archetype in enumerate(archetypes):
            numbers = torch.cat([data.observation[user], data.action[user]], dim=-1).flatten(0, 1).T.numpy()  # (14, n)
            rows = [np.full(len(tick), user), game, tick, tick * table.tick, [archetype] * len(tick), *numbers]
            writer.write_table(pa.table(dict(zip(COLUMNS, rows, strict=True)), schema))


def load(folder: Path | str) -> Demonstrations:
    """Read the demonstrations of a run folder of `airhockey collect` into memory.

    Raises:
        ValueError: the run is unfinished, or a file does not match the hash in its card.
        RuntimeError: the folder holds a pickle, which is not loaded.
    """
    folder = Path(folder)
    try:
        hashes = dict(json.loads((folder / CARD).read_text(encoding="utf-8"))["sha256"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder} is not a finished run of `airhockey collect`: no {CARD} with sha256") from error
    for name in sorted(name for name in hashes if name.startswith(f"{TENSORS}/")):
        if not (folder / name).is_file() or sha256(folder / name) != hashes[name]:
            raise ValueError(f"{folder / name} is missing or not the file that {CARD} lists")
    # Only after the check: mapping a file that is too short extends it with zeros.
    tensors = TensorDict.load_memmap(folder / TENSORS, allow_pickle=False)
    return Demonstrations(tensors["observation"].clone(), tensors["action"].clone())


def summary(data: Demonstrations, table: TableSpec) -> pd.DataFrame:
    """A row per user: goals per minute, mean and SD of the hand's speed in m/s and of the paddle's position in m."""
    starts = round_starts(data.observation, table)
    # a new round after a goal; the side of the puck in the tick before tells who scored
    goal, ahead = starts[..., 1:], data.observation[..., :-1, 8] > 0
    minutes = starts[0].numel() * table.tick / 60
    columns = {"scored_per_minute": (goal & ahead).sum((1, 2)) / minutes}
    columns["conceded_per_minute"] = (goal & ~ahead).sum((1, 2)) / minutes
    speed = hand_speed(data.observation, data.action, table)
    quantities = {"hand_m_s": speed, "own_x_m": data.observation[..., 0], "own_y_m": data.observation[..., 1]}
    for name, values in quantities.items():
        flat = values.flatten(1).double()
        columns |= {f"{name}_mean": flat.mean(dim=1), f"{name}_sd": flat.std(dim=1, correction=0)}
    return pd.DataFrame({name: values.double().numpy() for name, values in columns.items()})
