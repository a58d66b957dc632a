"""Atomic writes, and tensor files that are read without pickle."""

import pickle

import pytest
import torch

from airhockey_marl.experiment.files import atomic_write, load_tensors, save_tensors, write_text


def test_a_failed_write_keeps_the_old_file_and_leaves_no_other(tmp_path):
    path = tmp_path / "trials.csv"
    write_text(path, "old")
    with pytest.raises(RuntimeError, match="disk"), atomic_write(path) as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError("disk")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_tensors_and_facts_are_restored(tmp_path):
    tensors = {"a": torch.randn(3, 4), "b": torch.arange(6).view(2, 3).T}
    save_tensors(tmp_path / "x.safetensors", tensors, {"hidden": [64, 64]})
    loaded, facts = load_tensors(tmp_path / "x.safetensors")
    assert facts == {"hidden": [64, 64]}
    assert all(torch.equal(loaded[name], tensor) for name, tensor in tensors.items())


def test_files_of_other_formats_are_rejected_without_unpickling(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the pickle was loaded",))

    trap, cut = tmp_path / "trap.safetensors", tmp_path / "cut.safetensors"
    trap.write_bytes(pickle.dumps(Trap()))
    save_tensors(cut, {"a": torch.randn(100)})
    cut.write_bytes(cut.read_bytes()[:50])
    for path in (trap, cut):
        with pytest.raises(ValueError, match="is not a safetensors file"):
            load_tensors(path)
    with pytest.raises(ValueError, match="no such file"):
        load_tensors(tmp_path / "nowhere.safetensors")
