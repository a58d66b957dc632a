"""Exports: the same numbers without this package, with what a reader must know, or nothing."""

import io
import json

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from airhockey_marl import pretrained
from airhockey_marl.commands import export as command
from airhockey_marl.experiment.config import CONF, InputError
from airhockey_marl.experiment.files import sha256
from airhockey_marl.league.league import load_policy
from airhockey_marl.players import export
from guidance import pretrained as user_models
from guidance.study.models import save_user_model

LEAGUE, USER = pretrained.FOLDER / "league.safetensors", user_models.FOLDER / "now" / "user.safetensors"
OBSERVATION = torch.randn(7, 12, generator=torch.Generator().manual_seed(1))


def run(folder, *overrides: str) -> dict:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("export", overrides=[f"out={folder}", "samples=20", *overrides])
    cfg.model = cfg.model or str(LEAGUE)
    command.check(cfg)
    command.main(cfg)
    return json.loads((folder / "export.json").read_text())


@pytest.fixture
def adapted(tmp_path):
    """The file of one user's model."""
    models = user_models.models()
    weights = models.adapted_to([(torch.zeros(20, 12), torch.zeros(20, 2))])[0].flatten_keys(".").to_dict()
    models.meta.load_state_dict(weights)
    save_user_model(tmp_path / "adapted.safetensors", models.meta, {"user": 7, "ahead_s": 0.0})
    return tmp_path / "adapted.safetensors"


@pytest.mark.parametrize("kind", ["league", "user", "adapted"])
def test_exports_give_the_model_s_numbers_at_any_batch_size(kind, tmp_path, request):
    onnxruntime = pytest.importorskip("onnxruntime")
    file = {"league": LEAGUE, "user": USER}.get(kind) or request.getfixturevalue("adapted")
    generation = ["generation=40"] if kind == "league" else []
    card = run(tmp_path / "out", f"model={file}", *generation)
    policy, facts = load_policy(file, 40 if generation else None)
    session = onnxruntime.InferenceSession(tmp_path / "out" / "policy.onnx")
    extra = {export.METADATA_FILE: ""}
    program = torch.export.load(io.BytesIO((tmp_path / "out" / "policy.pt2").read_bytes()), extra_files=extra).module()
    for rows in (OBSERVATION, OBSERVATION[:1]):
        expected = [part.numpy() for part in policy(rows)]
        for results in (session.run(["mean", "std"], {"observation": rows.numpy()}), program(rows)):
            for result, part in zip(results, expected, strict=True):
                np.testing.assert_allclose(result, part, rtol=0, atol=1e-5)
    properties = session.get_modelmeta().custom_metadata_map
    assert json.loads(properties["source"]) == json.loads(extra[export.METADATA_FILE])["source"] == card["source"]
    assert card["source"] == {"file": file.name, "sha256": sha256(file), **facts}
    assert card["source"].get("generation") == (40 if kind == "league" else None)
    columns = card["inputs"]["observation"]
    assert [column["name"] for column in columns][7:9] == ["other_vy", "puck_x"] and columns[8]["unit"] == "m"
    assert set(card["max_abs_difference"]) == {"policy.onnx", "policy.pt2"}
    assert max(card["max_abs_difference"].values()) <= 1e-5


@pytest.mark.parametrize("offset", [2e-5, float("nan")])
def test_an_export_that_differs_is_refused_and_nothing_written(offset, tmp_path, monkeypatch):
    def differs(policy, metadata):
        return b"", lambda observation: (policy(observation)[0] + offset, policy(observation)[1])

    monkeypatch.setitem(export.EXPORTERS, "onnx", differs)
    monkeypatch.setitem(command.FORMATS, "onnx", ())
    with pytest.raises(InputError, match=r"^onnx: differs from the model by .*, must be at most 1e-05$"):
        run(tmp_path / "out", "formats=[pt2,onnx]")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["formats=[jit]"], r"^formats = \['jit'\] must be some of onnx, pt2$"),
        (["formats=[]"], r"^formats = \[\] must be some of onnx, pt2$"),
        (["generation=500", "formats=[pt2]"], r"^generation = 500 must be below 101, the number of generations$"),
        ([f"model={USER}", "generation=0", "formats=[pt2]"], r"^generation = 0 must be null: .* has one model$"),
        (["model=nothing.safetensors", "formats=[pt2]"], r"^no such file: nothing.safetensors$"),
    ],
)
def test_what_cannot_be_exported_is_named(overrides, message, tmp_path):
    with pytest.raises(InputError, match=message):
        run(tmp_path / "out", *overrides)


def test_without_the_extra_onnx_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(command.FORMATS, "onnx", ("onnx", "no_such_module"))
    with pytest.raises(InputError, match=r"needs no_such_module: pip install 'airhockey-haptics\[export\]', or "):
        run(tmp_path / "out")
    assert run(tmp_path / "out", "formats=pt2")["max_abs_difference"]["policy.pt2"] <= 1e-5
