"""Broken and hostile input is refused in one line or accepted where it is valid, and never executed."""

import json
import pickle
import struct
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from safetensors.torch import save_file

from airhockey_marl.commands import train
from airhockey_marl.experiment.checkpoint import Checkpoint
from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.command import run as start_command
from airhockey_marl.experiment.config import read_config, resumed_config
from airhockey_marl.experiment.files import load_tensors, save_tensors
from airhockey_marl.league.league import League
from airhockey_marl.players.networks import GaussianPolicy
from guidance.statistics.design import CONDITIONS, METRICS
from guidance.statistics.groups import merge
from guidance.statistics.report import write_report
from guidance.study.models import Models, load_user_model
from tests import ROOT
from tests.robustness.fuzz_inputs import ACCEPTED, KINDS, REFUSED, Trap, fuzz


def test_broken_input_is_refused():
    results = fuzz(4_000)
    assert not results["faults"], results["faults"][:5]
    assert all(sum(outcomes.values()) > 5 for outcomes in results["kinds"].values())
    for kind in KINDS:  # a target that accepts all or nothing does not test its loader
        outcomes = results["kinds"][kind]
        assert outcomes[ACCEPTED] or kind in ("huge", "pickled", "target", "tensors", "user_model", "training_state"), (
            kind
        )
        assert outcomes[REFUSED] or kind in ("safety", "force_equations"), kind


@pytest.mark.slow
def test_a_hundred_thousand_broken_inputs_are_refused():
    results = fuzz(100_000, seed=1)
    assert not results["faults"], results["faults"][:5]


def a_model(path: Path, facts: dict | None = None, **changes: torch.Tensor) -> Path:
    policy = GaussianPolicy([4])
    tensors = dict(policy.state_dict()) | {name.replace("_", "."): tensor for name, tensor in changes.items()}
    save_tensors(path, tensors, policy.architecture | {"inner_lr": 0.1} | (facts or {}))
    return path


@pytest.mark.parametrize(
    ("facts", "changes", "message"),
    [
        ({"hidden": "64"}, {}, r"hidden = '64' must name at least one layer"),
        ({"hidden": None}, {}, r"hidden = None must name"),
        ({"hidden": [4.0]}, {}, r"hidden = \(4\.0,\) must name"),
        ({"hidden": [True]}, {}, r"hidden = \(True,\) must name"),
        ({"hidden": [2**40]}, {}, r"weights, must be at most 10000000"),  # and no memory is asked for
        ({"hidden": [10**5] * 3}, {}, r"weights, must be at most 10000000"),
        ({"inputs": ["table"]}, {}, r"inputs = \['table'\] must be 'table' or 'paddle'"),
        (
            {},
            {"head_bias": torch.full((4,), torch.nan)},
            r"head\.bias has 4 values that are not finite, must have none",
        ),
        ({}, {"head_bias": torch.zeros(4, dtype=torch.int64)}, r"head\.bias is torch\.int64, must be floating point"),
        ({}, {"head_bias": torch.zeros(5)}, r"head\.bias is \(5,\), the model has \(4,\)"),
        ({}, {"head_more": torch.zeros(5)}, r"head\.more is \(5,\), the model has no such tensor"),
    ],
)
def test_the_fault_of_an_invalid_model_is_named(tmp_path, facts, changes, message):
    path = a_model(tmp_path / "user.safetensors", facts, **changes)
    with pytest.raises(ValueError, match=message) as refused:
        load_user_model(path)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"inner_lr": float("nan")}, "inner_lr = nan must be a finite number of at least 0 and at most 1000"),
        ({"inner_lr": "0.1"}, "inner_lr = '0.1' must be a finite number"),
        ({"ahead_s": -1.0}, "ahead_s = -1.0 must be a finite number of at least 0 and at most 1"),
        ({"ahead_s": [0]}, r"ahead_s = \[0\] must be a finite number"),
    ],
)
def test_the_metadata_of_a_model_is_checked(tmp_path, facts, message):
    shipped = ROOT / "airhockey_marl/pretrained/league.safetensors"
    user = a_model(tmp_path / "user.safetensors")
    with pytest.raises(ValueError, match=message):
        Models.load(shipped, -1, user, a_model(tmp_path / "meta.safetensors", facts))


def test_a_flipped_bit_is_found(tmp_path):
    """Even where the resulting number is plausible."""
    path = a_model(tmp_path / "user.safetensors")
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is damaged: its content is not what its own hash says"):
        load_user_model(path)
    tensors, facts = {"a": torch.zeros(3)}, {"x": 1}
    save_file(tensors, path, metadata={"facts": json.dumps(facts)})  # as older versions wrote it
    assert load_tensors(path)[1] == facts


def test_tensors_with_different_numbers_of_generations_are_refused(tmp_path):
    policy, path = GaussianPolicy([4]), tmp_path / "league.safetensors"
    stacked = {name: tensor[None].expand(3, *tensor.shape).clone() for name, tensor in policy.state_dict().items()}
    for wrong in ({"head.bias": torch.zeros(2, 4)}, {name: tensor[:0] for name, tensor in stacked.items()}):
        save_tensors(path, stacked | wrong, policy.architecture)
        with pytest.raises(ValueError, match=r"has \d generations, must have \d"):
            League.load(path)


def test_a_header_that_claims_terabytes_is_refused(tmp_path):
    path = tmp_path / "huge.safetensors"
    path.write_bytes(struct.pack("<Q", 2**43) + b"{}")
    with pytest.raises(ValueError, match="is not a safetensors file"):
        load_tensors(path)
    header = json.dumps({"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header)
    with pytest.raises(ValueError, match="is not a safetensors file"):
        load_tensors(path)


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({}, "generation = None must be a int"),
        ({"generation": "9"}, "generation = '9' must be a int"),
        ({"generation": 1, "rng": {"bit_generator": "MT19937"}}, "has random numbers of another kind"),
    ],
)
def test_a_checkpoint_of_another_kind_is_refused(tmp_path, facts, message):
    path = tmp_path / "state.safetensors"
    checkpoint = Checkpoint({"policy": GaussianPolicy([4])}, np.random.default_rng(0), [])
    checkpoint.save(path, {})
    tensors, known = load_tensors(path)
    save_tensors(path, tensors, known | facts)
    with pytest.raises(ValueError, match=message):
        checkpoint.load(path, {"generation": int})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("a: [", "is no yaml"),
        ("- 1\n", "must be a table of keys and values"),
        ("seed: 1\n", "is not the configuration of a run"),
        ("x: !!python/object/apply:os.system ['touch executed']\nresume: null\n", "is no yaml"),
    ],
)
def test_a_foreign_run_folder_executes_nothing(tmp_path, monkeypatch, content, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "config.yaml").write_text(content)
    (tmp_path / "state").touch()
    with pytest.raises(ValueError, match=message):
        resumed_config(tmp_path, "state")
    assert not (tmp_path / "executed").exists()


def nested(first: str, level: str, reference: str, separator: str = "") -> str:
    """A yaml of twelve levels, each of which refers nine times to the level before."""
    levels = [level.format(i, separator.join([reference.format(i - 1)] * 9)) for i in range(1, 12)]
    return "\n".join(["resume: null", first, *levels, ""])


LAUGHS = nested("a0: &a0 ha", "a{0}: &a{0} [{1}]", "*a{}", ", ")
TEXTS = nested("a0: ha", "a{0}: '{1}'", "${{a{}}}")
LISTS = nested("a0: [ha]", "a{0}: [{1}]", "'${{a{}}}'", ", ")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (LAUGHS, "has aliases, or more than 16 references"),
        ("resume: null\nx: &x {y: 1}\nz: {<<: *x}\n", "has aliases, or more than 16 references"),
        (TEXTS, "has aliases, or more than 16 references"),
        (LISTS, "has aliases, or more than 16 references"),
        ("resume: null\nx: " + "[" * 14_000 + "]" * 14_000, "is no yaml"),
        ("resume: null\nx: " + "x" * 30_000, "is of more than 30000 bytes"),
        ("resume: null\nx: " + "9" * 20_000, "is no yaml"),
        ("resume: null\n\xff", "is no yaml"),
    ],
    ids=["aliases", "a merge", "texts", "lists", "depth", "size", "a number", "no UTF-8"],
)
def test_a_small_configuration_cannot_take_much_memory(tmp_path, content, message):
    """Each, such as the first, a "billion laughs", would take gigabytes or exhaust the stack when read naively."""
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "config.yaml").write_bytes(content.encode("latin-1"))
    (tmp_path / "state").touch()
    tracemalloc.start()
    with pytest.raises(ValueError, match=message) as refused:
        resumed_config(tmp_path, "state")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6 and "\n" not in str(refused.value)


def test_the_configuration_that_hydra_writes_is_accepted(tmp_path):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for name in sorted(path.stem for path in CONF.glob("*.yaml")):
            OmegaConf.save(compose(name), tmp_path / "config.yaml")
            assert read_config(tmp_path / "config.yaml") == OmegaConf.load(tmp_path / "config.yaml")


def test_an_accepted_configuration_grows_little(tmp_path):
    """The worst accepted case: as many references to references as are allowed."""
    file = tmp_path / "config.yaml"
    file.write_text(f"a0: {'x' * 20_000}\n" + "".join(f"a{i + 1}: '{f'${{a{i}}}' * 3}'\n" for i in range(5)))
    longest = max(len(str(value)) for value in OmegaConf.to_container(read_config(file), resolve=True).values())
    assert longest == 3**5 * 20_000


@pytest.mark.parametrize("state", ["pickle", "torch", "cut"])
def test_a_hostile_checkpoint_is_refused_in_one_line(tmp_path, monkeypatch, capsys, state):
    """Resume with a pickle, or a truncated file, in place of the weights."""
    run, trap = tmp_path / "run", tmp_path / "executed"
    (run / ".hydra").mkdir(parents=True)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        OmegaConf.save(compose("train", overrides=["+preset/train=smoke"]), run / ".hydra" / "config.yaml")
    policy = GaussianPolicy([64, 64], "paddle")
    league = League(policy)
    league.add(policy)
    league.save(run / "league.safetensors")
    file = run / "state.safetensors"
    if state == "pickle":
        file.write_bytes(pickle.dumps(Trap(trap)))
    elif state == "torch":
        torch.save({"generation": Trap(trap)}, file)
    else:
        file.write_bytes((run / "league.safetensors").read_bytes()[:1000])
    monkeypatch.setattr(sys, "argv", ["train", f"resume={run}", f"hydra.run.dir={tmp_path}/log"])
    with pytest.raises(SystemExit) as stopped:
        start_command(train.__name__)
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1, said
    assert said.startswith(f"error: {file} is not a safetensors file") and not trap.exists()


EVIL = "<script>alert(1)</script>"


def trials_of(users: list[str]) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    rows = [
        {"user": user, "condition": name, "position": 1, "seed": 1}
        | dict(zip(METRICS, [*rng.uniform(0, 1, 4), *rng.uniform(1, 7, 4)], strict=True))
        | {f"{weight}_{part}": 0.5 for weight in ("w_unc_optimal", "w_unc_user", "w_sim") for part in ("mean", "sd")}
        for user in users
        for name in CONDITIONS
    ]
    return pd.DataFrame(rows)


def test_the_report_escapes_text_of_users(tmp_path):
    trials = trials_of([EVIL, "=cmd|' /C calc'!A0", "S3", "S4"]).iloc[1:]  # the first has not finished
    manifest = {"participants": "people", "config": {"participants": 20, "note": EVIL}, EVIL: f'"{EVIL}'}
    write_report(trials, tmp_path, manifest)
    page = (tmp_path / "report.html").read_text()
    assert "<script" not in page and "&lt;script&gt;" in page


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A0", "+1", "-1+1", "@SUM(A1)", "a\tb", "\x1b[2J"])
def test_a_name_that_a_spreadsheet_would_execute_is_refused(tmp_path, text):
    trials_of(["S1", text]).to_csv(tmp_path / "trials.csv", index=False)
    with pytest.raises(ValueError, match="must be a name, and begin with none of =") as refused:
        merge([tmp_path])
    assert "\n" not in str(refused.value) and "\x1b" not in str(refused.value)
