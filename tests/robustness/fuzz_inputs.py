"""Fuzz every loader, the configuration and the force layer with broken and hostile input.

    python -m tests.robustness.fuzz_inputs 100000        number of cases; prints the outcomes by target as JSON

A case follows from its number alone. The outcome is right if the input was accepted, or refused with a `ValueError`
(such as `InputError`); any other exception is a fault, and so is any sign that input was executed.
"""

import json
import math
import os
import pickle
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from safetensors.torch import save_file

from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.experiment.checkpoint import Checkpoint
from airhockey_marl.experiment.command import require_counts, require_numbers
from airhockey_marl.experiment.config import resumed_config
from airhockey_marl.experiment.files import load_tensors, save_tensors
from airhockey_marl.experiment.registry import construct
from airhockey_marl.league.league import League
from airhockey_marl.league.opponent_sampling import OPPONENT_SAMPLERS
from airhockey_marl.players.networks import GaussianPolicy
from guidance.forces.equations import similarity_weight, spring_force, uncertainty_weight
from guidance.haptics.safety import Safety, SafetyLimits
from guidance.sessions.bids import Records
from guidance.sessions.participant import check_label
from guidance.sessions.tick_log import COLUMNS, read_ticks
from guidance.statistics.groups import merge
from guidance.study.models import load_user_model

ACCEPTED, REFUSED, FAULT = "accepted", "refused", "fault"
ODD = [0.0, -0.0, 1e-320, 1e308, -1e308, math.inf, -math.inf, math.nan, 3.0, 1e-9]


class Trap:
    """An object whose pickle creates the file `place` when it is loaded."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self):
        return (os.system, (f"touch {self.place}",))


def outcome(task: Callable[[], object]) -> str:
    """Outcome of a task that loads input; other exceptions than of a refusal are raised."""
    try:
        task()
    except OmegaConfBaseException:
        return REFUSED  # the command line prints it in one line
    except ValueError as error:
        assert str(error).strip(), "refused without a message"
        return REFUSED
    return ACCEPTED


def damage(content: bytes, rng: np.random.Generator) -> bytes:
    """A copy that is truncated, or has bits flipped, bytes inserted, or bytes overwritten."""
    kind, data = rng.integers(6), bytearray(content)
    if kind == 0:
        return bytes(data[: rng.integers(len(data))])
    if kind == 1:
        for place in rng.integers(len(data), size=rng.integers(1, 9)):
            data[place] ^= 1 << int(rng.integers(8))
    elif kind == 2:  # in the header
        for place in rng.integers(min(len(data), 200), size=rng.integers(1, 5)):
            data[place] = int(rng.integers(256))
    elif kind == 3:
        at = int(rng.integers(len(data)))
        data[at:at] = rng.bytes(int(rng.integers(1, 50)))
    elif kind == 4:
        data[:8] = struct.pack("<Q", int(rng.integers(2**62)))
    else:
        at = int(rng.integers(len(data)))
        data[at : at + 20] = rng.choice(
            [b"-1", b"1e999", b"null", b"[[", b'"', b"\xff\xfe", b"=cmd|", b"\t\t", b"\n", b"NaN", b"\0"]
        )
    return bytes(data)


class Targets:
    """Valid files of every kind in a folder; each method that takes a generator fuzzes one loader."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.trap = folder, folder / "executed"
        self.file = folder / "input.safetensors"
        policy = GaussianPolicy([4])
        save_tensors(self.file, policy.state_dict(), {**policy.architecture, "inner_lr": 0.1})
        self.models = self.file.read_bytes(), self.without_hash()
        league = League(policy)
        for _ in range(2):
            league.add(policy)
        league.save(self.file)
        self.leagues = self.file.read_bytes(), self.without_hash()
        self.checkpoint().save(self.file, {"generation": 1})
        self.states = self.file.read_bytes(), self.without_hash()
        self.csv = b"user,condition,seed,win_rate,mean_smash_speed,defense_rate,mean_disagreement,helpfulness,"
        self.csv += (
            b"naturalness,controllability,comfort\nS01,nhg,1,.5,2.0,.5,.1,4,4,4,4\nS02,oahg,1,.5,2,.5,.1,4,4,4,4\n"
        )
        self.tsv = "\t".join(COLUMNS).encode() + b"\n" + b"\t".join(b"0.5" for _ in COLUMNS) + b"\n"
        self.yaml = b"resume: null\nseed: 1\nmaml:\n  block: 3\n  lr: 0.1\npart:\n  force: 3.0\n"
        self.yaml += b"# a comment, in which damage leaves the settings as they are\n" * 2

    def checkpoint(self) -> Checkpoint:
        policy = GaussianPolicy([4])
        optimizer = torch.optim.Adam(policy.parameters())
        policy(torch.zeros(1, 12))[0].sum().backward()
        optimizer.step()
        return Checkpoint(
            {"policy": policy, "optimizer": optimizer}, np.random.default_rng(0), [np.zeros(3, np.uint64)]
        )

    def without_hash(self) -> bytes:
        """The file without its hash, as older versions wrote it: damage then gets past the hash check."""
        tensors, facts = load_tensors(self.file)
        save_file(tensors, self.file, metadata={"facts": json.dumps(facts)})
        return self.file.read_bytes()

    def put(self, content: bytes, name: str = "input.safetensors") -> Path:
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        return path

    def tensors(self, rng: np.random.Generator) -> str:
        return outcome(lambda: load_tensors(self.put(damage(self.models[rng.integers(2)], rng))))

    def user_model(self, rng: np.random.Generator) -> str:
        return outcome(lambda: load_user_model(self.put(damage(self.models[rng.integers(2)], rng))))

    def generations(self, rng: np.random.Generator) -> str:
        return outcome(lambda: League.load(self.put(damage(self.leagues[rng.integers(2)], rng))))

    def training_state(self, rng: np.random.Generator) -> str:
        return outcome(
            lambda: self.checkpoint().load(self.put(damage(self.states[rng.integers(2)], rng)), {"generation": int})
        )

    def strange_model(self, rng: np.random.Generator) -> str:
        """Intact files with strange metadata or tensors."""
        facts = {"hidden": [4], "inputs": "table", "inner_lr": 0.1}
        values = [None, "x", -1, 2.5, [], [4, "a"], [2**40], {}, True, [[4]], [0], [4.0], "table", 1e300, [4, 4]]
        facts[str(rng.choice(list(facts)))] = values[rng.integers(len(values))]
        tensors = dict(GaussianPolicy([4]).state_dict())
        name = str(rng.choice(list(tensors)))
        kind = rng.integers(6)
        if kind == 0:
            tensors[name] = tensors[name] * math.nan
        elif kind == 1:
            tensors[name] = tensors[name].int()
        elif kind == 2:
            tensors[name] = tensors[name][None]
        elif kind == 3:
            tensors.pop(name)
        elif kind == 4:
            tensors[name + "x"] = tensors[name].clone()
        save_tensors(self.file, tensors, facts)
        load = [load_user_model, League.load][rng.integers(2)]
        return outcome(lambda: load(self.file))

    def huge(self, rng: np.random.Generator) -> str:
        """A header that claims more data than the file has."""
        shape = [int(rng.integers(2**62)) for _ in range(rng.integers(1, 4))]
        header = {"a": {"dtype": "F32", "shape": shape, "data_offsets": [0, int(rng.integers(2**62))]}}
        text = json.dumps(header).encode()
        length = len(text) if rng.random() < 0.5 else int(rng.integers(2**62))
        result = outcome(lambda: load_tensors(self.put(struct.pack("<Q", length) + text)))
        assert result == REFUSED
        return result

    def pickled(self, rng: np.random.Generator) -> str:
        data = pickle.dumps(Trap(self.trap), protocol=int(rng.integers(6)))
        if rng.random() < 0.5:
            torch.save({"x": Trap(self.trap)}, self.file)
        else:
            self.put(data)
        load = [load_tensors, load_user_model, League.load][rng.integers(3)]
        result = outcome(lambda: load(self.file))
        assert result == REFUSED
        return result

    def trials(self, rng: np.random.Generator) -> str:
        path = self.put(damage(self.csv, rng), "trials/trials.csv")
        return outcome(lambda: merge([path]))

    def manifest(self, rng: np.random.Generator) -> str:
        path = self.put(self.csv, "other/trials.csv")
        self.put(damage(b'{"study_hash": "ab", "seed": 3, "participants": "people"}', rng), "other/manifest.json")
        return outcome(lambda: merge([path]))

    def game(self, rng: np.random.Generator) -> str:
        path = self.put(damage(self.tsv, rng), "game.tsv")
        return outcome(lambda: read_ticks(path))

    def places(self, rng: np.random.Generator) -> str:
        folder = self.folder / "study"
        facts = {"study_hash": "x", "seed": 1}
        if not folder.exists():
            with Records(folder, facts) as records:
                records.participant("P01")
        name = ["participants.tsv", "manifest.json"][rng.integers(2)]
        good = (folder / name).read_bytes()
        (folder / name).write_bytes(damage(good, rng))
        try:
            return outcome(lambda: Records(folder, facts).close())
        finally:
            (folder / name).write_bytes(good)

    def label(self, rng: np.random.Generator) -> str:
        """Labels that would lead out of the folder."""
        parts = ["..", "/", "\\", "P1", "\0", ".", "a", "~", "%2e", "CON", "\n", "é", "$(id)", "sub-", " ", "nan"]
        label = "".join(rng.choice(parts, size=rng.integers(0, 5)))
        result = outcome(lambda: check_label(label))
        assert result == REFUSED or (label.isalnum() and label.isascii() and len(label) <= 16), label
        return result

    def config(self, rng: np.random.Generator) -> str:
        self.put(b"", "run/state")
        (self.folder / "run" / ".hydra").mkdir(exist_ok=True)
        content = damage(self.yaml, rng)
        if rng.random() < 0.3:
            content += f"x: !!python/object/apply:os.system ['touch {self.trap}']\n".encode()
        self.put(content, "run/.hydra/config.yaml")

        def resume() -> None:
            cfg = resumed_config(self.folder / "run", "state")
            require_counts(cfg, "maml.block", "seed")
            require_numbers(cfg, "maml.lr")
            construct(SafetyLimits, cfg.part, "part")

        return outcome(resume)

    def target(self, rng: np.random.Generator) -> str:
        names = ["os.system", "builtins.exec", "guidance.haptics.servo_process.ServoProcess", "../trpo", "trpo", ""]
        key = ("name", "_target_")[rng.integers(2)]
        node: object = {key: str(rng.choice(names)), "command": f"touch {self.trap}"}
        for _ in range(rng.integers(4)):
            node = [{"deeper": node}, [1, node], {"name": "mixture", "samplers": [node]}][rng.integers(3)]
        registry = (ALGORITHMS, OPPONENT_SAMPLERS)[rng.integers(2)]
        result = outcome(lambda: registry.build(OmegaConf.create({"part": node}).part, "part"))
        assert result == REFUSED
        return result

    def overrides(self, rng: np.random.Generator) -> str:
        values = [*ODD, None, "x", True, [], {}, 2**70, -1, "1", "${seed}", "${nowhere}", "???"]
        cfg = OmegaConf.create({"seed": 1, "maml": {"block": values[rng.integers(len(values))]}})
        low = [0.0, -1.0, 1.0][rng.integers(3)]
        if rng.random() < 0.5:
            return outcome(lambda: require_counts(cfg, "maml.block", least=int(low)))
        return outcome(lambda: require_numbers(cfg, "maml.block", above=low, at_most=10.0))

    def safety(self, rng: np.random.Generator) -> str:
        """Any request at any state of the hand: the force is finite, within its limit and within its slew rate."""
        limits = SafetyLimits(*np.exp(rng.uniform(-3, 6, 6)).tolist())
        layer, before = Safety(limits), (0.0, 0.0)

        def number(scale: float) -> float:
            return ODD[rng.integers(len(ODD))] if rng.random() < 0.2 else float(rng.normal(0, scale))

        for _ in range(20):
            position = (number(limits.workspace / 3), number(limits.workspace / 3))
            velocity = (number(limits.speed / 3), number(limits.speed / 3))
            seconds = ODD[rng.integers(len(ODD))] if rng.random() < 0.05 else float(rng.uniform(1e-4, 0.1))
            force = (number(3 * limits.force), number(3 * limits.force))
            filtered = layer.filter(force, abs(number(0.03)), position, velocity, rng.random() < 0.8, seconds)
            assert math.isfinite(filtered[0]) and math.isfinite(filtered[1]), filtered
            assert math.hypot(*filtered) <= limits.force, filtered
            if layer.fault is None:
                change = math.hypot(filtered[0] - before[0], filtered[1] - before[1])
                assert change <= limits.slew * seconds * (1 + 1e-9) + 1e-12, (filtered, before)
            else:
                assert filtered == (0.0, 0.0)
                layer.release()
            before = filtered
        return ACCEPTED

    def force_equations(self, rng: np.random.Generator) -> str:
        kind = torch.float32 if rng.random() < 0.5 else torch.float64

        def vector() -> torch.Tensor:
            largest = 30 if kind is torch.float32 else 250
            return torch.tensor(rng.normal(size=2) * 10.0 ** rng.integers(-largest, largest, 2), dtype=kind)

        limit, stiffness = 10.0 ** rng.uniform(-3, 3), 10.0 ** rng.uniform(-3, 6)
        force = spring_force(vector(), vector(), stiffness, limit)
        assert force.isfinite().all() and force.double().norm() <= limit * (1 + 1e-5)
        for weight in (similarity_weight(vector(), vector()), uncertainty_weight(vector().abs(), 0.1, 0.5)):
            assert 0 <= weight <= 1
        return ACCEPTED


HELPERS = ("checkpoint", "without_hash", "put")
KINDS = [name for name, value in vars(Targets).items() if callable(value) and name[0] != "_" and name not in HELPERS]
# Relative cost of a case: the expensive ones are drawn less often.
COST = {"training_state": 4, "places": 8, "pickled": 2, "trials": 4, "game": 2, "config": 4, "manifest": 4}


def fuzz(cases: int, seed: int = 0) -> dict:
    """Run so many cases: numbers of outcomes by target, and a line per fault."""
    outcomes: Counter[tuple[str, str]] = Counter()
    faults, began = [], time.perf_counter()
    probabilities = np.array([1 / COST.get(kind, 1) for kind in KINDS])
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        targets = Targets(Path(folder))
        for number in range(cases):
            rng = np.random.default_rng([seed, number])
            kind = str(rng.choice(KINDS, p=probabilities / probabilities.sum()))
            try:
                result = getattr(targets, kind)(rng)
                assert not targets.trap.exists(), "something was executed"
            except Exception as error:  # of any type: the fuzz looks for them
                result = FAULT
                faults.append(f"{kind} [{seed}, {number}]: {type(error).__name__}: {str(error)[:200]}")
            outcomes[kind, result] += 1
    kinds = {kind: {result: outcomes[kind, result] for result in (ACCEPTED, REFUSED, FAULT)} for kind in KINDS}
    return {"cases": cases, "seconds": time.perf_counter() - began, "faults": faults, "kinds": kinds}


if __name__ == "__main__":
    results = fuzz(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    results["faults"] = results["faults"][:40]
    print(json.dumps(results, indent=1))
