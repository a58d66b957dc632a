"""Event files for TensorBoard: a run's settings and tags, pictures, final scores, and writers that resume.

The code that writes tags explains them: it passes `log_run_header` a text per tag and a layout of charts. torch and PIL
are imported by the functions that need them.
"""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import yaml
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.config import flatten_settings

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

Layout = Mapping[str, Mapping[str, Sequence[str]]]  # by category and title of the chart, regular expressions of tags

# by tag, with * for a part that varies, what it is: tags of every run
COMMON_TAGS = {"card/text_summary": "the resolved configuration", "names/text_summary": "this table"}
# settings of how a run is executed, which do not change its results
NOT_SETTINGS = ("resume", "threads", "compute", "pictures_every")
SCORES = "scores"  # subfolder of the scores on the HPARAMS page


def code_block(text: str) -> str:
    """Markdown that shows a text verbatim."""
    return "".join(f"    {line}\n" for line in text.splitlines())


def log_run_header(writer: SummaryWriter, cfg: DictConfig, tags: Mapping[str, str], layout: Layout) -> None:
    """Log what a run is, once, at its beginning.

    The TEXT page shows `cfg` as card, and `tags`, with * for a part that varies, as table of names; `layout` are the
    charts of the CUSTOM SCALARS page.
    """
    charts = {
        category: {title: ["Multiline", list(patterns)] for title, patterns in titles.items()}
        for category, titles in layout.items()
    }
    writer.add_custom_scalars(charts)
    tree = OmegaConf.to_container(cfg, resolve=True)
    writer.add_text("card", code_block(yaml.safe_dump(tree, sort_keys=False, width=100, default_flow_style=None)))
    texts = {**tags, **COMMON_TAGS}
    rows = "".join(f"| `{tag.removesuffix('/text_summary')}` | {text} |\n" for tag, text in texts.items())
    writer.add_text("names", f"| name | what it is |\n|---|---|\n{rows}")


def add_picture(writer: SummaryWriter, tag: str, content: bytes, step: int) -> None:
    """Log a PNG or an animated GIF without encoding it anew.

    `SummaryWriter.add_image` decodes and encodes, and its `add_video` needs a moviepy older than version 2.
    """
    from PIL import Image
    from tensorboard.compat.proto.summary_pb2 import Summary

    with Image.open(io.BytesIO(content)) as picture:
        width, height = picture.size
    image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=content)  # 3: RGB
    writer._get_file_writer().add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)


def log_final_scores(folder: Path | str, cfg: DictConfig, scores: Mapping[str, float], step: int = 0) -> None:
    """Log the scores of a finished run as `score/*`, and on the HPARAMS page beside its settings.

    TensorBoard fills that page from the settings of all runs and every scalar in their folders. So the scores have a
    folder of their own, and no experiment description: the page would take the first that it finds, and show only its
    settings and scores for the runs of all commands. NaN are left out.
    """
    from torch.utils.tensorboard.summary import hparams

    scalars = {f"score/{name}": float(value) for name, value in scores.items() if value == value}
    settings = {
        name: value if isinstance(value, bool | int | float | str) else json.dumps(value)
        for name, value in flatten_settings(OmegaConf.to_container(cfg, resolve=True)).items()
        if name.rpartition(".")[2] not in NOT_SETTINGS
    }
    # purge_step 0: a resumed run that ends a second time has its scores once
    with open_writer(tensorboard_dir(folder) / SCORES, purge_step=0) as writer:
        for summary in hparams(settings, scalars)[1:]:  # [0] is the experiment description
            writer._get_file_writer().add_summary(summary)
        for name, value in scalars.items():
            writer.add_scalar(name, value, step)


def tensorboard_dir(folder: Path | str) -> Path:
    """The folder of a run's event files."""
    return Path(folder) / "tensorboard"


def open_writer(folder: Path, purge_step: int | None = None) -> SummaryWriter:
    """A writer of event files; in a resumed run TensorBoard drops what earlier files have from `purge_step` on."""
    from torch.utils.tensorboard import SummaryWriter

    threading.excepthook = _report_thread_error
    return SummaryWriter(str(folder), purge_step=purge_step)


def _report_thread_error(args: threading.ExceptHookArgs) -> None:
    """Print the traceback of a thread, except of TensorBoard's, whose OSError the next write or flush raises again."""
    if not (isinstance(args.exc_value, OSError) and type(args.thread).__module__.startswith("tensorboard.")):
        threading.__excepthook__(args)
