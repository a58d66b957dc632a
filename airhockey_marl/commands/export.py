"""Export a policy or a user model for programs without this package: ONNX and torch.export.

    airhockey export                                       the last generation of the shipped league
    airhockey export model=outputs/train/.../league.safetensors generation=40
    airhockey export model=guidance/pretrained/now/user.safetensors formats=[pt2]

Writes into its run folder: policy.onnx, policy.pt2, and export.json with what is in both as metadata: names and units
of inputs and outputs, the file that they are of with its SHA-256, and the largest difference from the original. It is
measured on random observations; nothing is written if it is above 1e-5. The scaling of inputs is part of the export,
and a batch can have any size. ONNX needs what `pip install 'airhockey-haptics[export]'` brings.
"""

from importlib.util import find_spec
from pathlib import Path

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import sha256, write_bytes, write_json
from airhockey_marl.experiment.run_folder import output_folder

FORMATS = {"onnx": ("onnx", "onnxscript", "onnxruntime"), "pt2": ()}  # and the modules that they need


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "samples")
    formats = chosen(cfg)
    if not formats or not {*formats} <= {*FORMATS}:
        raise InputError(f"formats = {formats} must be some of {', '.join(FORMATS)}")
    missing = [module for form in formats for module in FORMATS[form] if find_spec(module) is None]
    if missing:
        install = "pip install 'airhockey-haptics[export]', or formats=[pt2] does without"
        raise InputError(f"formats = {formats} needs {', '.join(missing)}: {install}")


def chosen(cfg: DictConfig) -> list[str]:
    """The formats to write; one can be typed without brackets."""
    return [cfg.formats] if isinstance(cfg.formats, str) else list(cfg.formats)


def main(cfg: DictConfig) -> None:
    """Export in all formats, compare, and only then write."""
    import torch

    from airhockey_marl.league.league import load_policy
    from airhockey_marl.players.export import INTERFACE, export_policy

    with report_input_errors():
        policy, facts = load_policy(cfg.model, cfg.generation)
        metadata = {
            **INTERFACE,
            "source": {"file": Path(cfg.model).name, "sha256": sha256(cfg.model), **facts},
            "made_by": f"airhockey export, torch {torch.__version__}",
        }
        files = {form: export_policy(policy, form, metadata, cfg.samples, cfg.seed) for form in chosen(cfg)}
    folder = output_folder(cfg)
    for form, (content, _) in files.items():
        write_bytes(folder / f"policy.{form}", content)
    differences = {f"policy.{form}": difference for form, (_, difference) in files.items()}
    write_json(folder / "export.json", {**metadata, "max_abs_difference": differences})
    for name, difference in differences.items():
        print(f"{folder / name}: differs from the model by at most {difference:.1g}")
