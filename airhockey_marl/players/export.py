"""Policies for programs without this package: ONNX and torch.export, scaling included, compared with the original."""

import io
import json
import logging
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from airhockey_marl.players.networks import BODY_SCALE, GaussianPolicy

TOLERANCE = 1e-5  # largest difference from the original that an export may have
METADATA_FILE = "metadata.json"  # in a pt2 archive
INTERFACE = {
    "frame": "from the table's center, x toward the opponent, y to the agent's left",
    "inputs": {
        "observation": [
            {"name": f"{body}_{axis}", "unit": unit}
            for body in ("own", "other", "puck")
            for axis, unit in {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}.items()
        ]
    },
    "outputs": {
        "mean": "x and y of the action: the position that the own paddle goes to, 0 at the midpoint of the own side, "
        "+-1 at the bounds of the paddle's center; may lie outside",
        "std": "standard deviations of both, in the same unit, above 0",
    },
}

Run = Callable[[Tensor], Iterable[Tensor]]  # observations (n, 12) -> mean and STD (n, 2)
EXAMPLE, SHAPES = torch.zeros(2, 12), ({0: torch.export.Dim("batch")},)


def to_pt2(policy: GaussianPolicy, metadata: Mapping[str, Any]) -> tuple[bytes, Run]:
    """A file of `torch.export.save`, and the program in it; the metadata are its extra file `METADATA_FILE`."""
    program, file = torch.export.export(policy, (EXAMPLE,), dynamic_shapes=SHAPES), io.BytesIO()
    torch.export.save(program, file, extra_files={METADATA_FILE: json.dumps(metadata)})
    return file.getvalue(), torch.export.load(io.BytesIO(file.getvalue())).module()


def to_onnx(policy: GaussianPolicy, metadata: Mapping[str, Any]) -> tuple[bytes, Run]:
    """An ONNX file, and a session of ONNX Runtime with it; the metadata are its properties, JSON where not text."""
    import onnx
    import onnxruntime

    names = {"input_names": ["observation"], "output_names": ["mean", "std"]}
    with _quiet():
        proto = torch.onnx.export(policy, (EXAMPLE,), dynamic_shapes=SHAPES, verbose=False, **names).model_proto
    properties = {key: value if isinstance(value, str) else json.dumps(value) for key, value in metadata.items()}
    onnx.helper.set_model_props(proto, properties)
    onnx.checker.check_model(proto, full_check=True)
    session = onnxruntime.InferenceSession(proto.SerializeToString(), providers=["CPUExecutionProvider"])

    def run(observation: Tensor) -> Iterable[Tensor]:
        return map(torch.from_numpy, session.run(None, {"observation": observation.numpy()}))

    return proto.SerializeToString(), run


EXPORTERS = {"onnx": to_onnx, "pt2": to_pt2}


@torch.no_grad()
def export_policy(
    policy: GaussianPolicy, form: str, metadata: Mapping[str, Any], samples: int, seed: int
) -> tuple[bytes, float]:
    """A policy as a file of a form of `EXPORTERS`, and its largest difference from the policy.

    It is measured on random observations, all at once and the first alone.

    Raises:
        ValueError: it is above `TOLERANCE`.
    """
    content, run = EXPORTERS[form](policy.eval(), metadata)
    random = torch.rand(samples, 12, generator=torch.Generator().manual_seed(seed))
    observation, difference = (2 * random - 1) * torch.tensor(BODY_SCALE * 3), 0.0
    for rows in (observation, observation[:1]):
        for expected, result in zip(policy(rows), run(rows), strict=True):
            difference = max(difference, (expected - result).abs().max().nan_to_num(torch.inf).item())
    if difference > TOLERANCE:
        raise ValueError(f"{form}: differs from the model by {difference:.2g}, must be at most {TOLERANCE:g}")
    return content, difference


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what libraries log and warn of themselves."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(logging.NOTSET)
