"""What TensorBoard shows of a run: a fixed vocabulary, its layout, the settings as a card and as hyperparameters.

VOCABULARY explains every tag that any command writes; the tests hold the event files against it.
"""

import io
import json
import re
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

# tag, with * for what varies, and what it is; x is the number of steps of play unless said otherwise
VOCABULARY = {
    "update/*": "what the algorithm says of its updates, averaged over a generation (TRPO: kl, gain, step, std, ...)",
    "win_rate_against/*": "share of decided rounds that a new generation wins against an older one or a script",
    "speed/steps_per_s": "steps of play per second since the run began; the only scalars that two equal runs differ in",
    "league/*": "pictures while it learns: win_rates, of the generations so far, when each was the newest, against "
    "those before it and the scripts; and film, some seconds of the newest (left, blue) against the striker",
    "rating/*": "Elo points above generation 0, of the generations of the payoff matrix and of the scripts",
    "save_rate/*": "share of the striker's shots that are saved, by the last generation and by the defender",
    "std/*": "mean STD of the last generation's actions, in units of action, by situation",
    "report/*": "pictures: payoff (who beats whom), rating, precision, and match, a film",
    "maml/*": "per epoch: loss of Eq. 3 after adaptation (Eq. 2), and loss_before it",
    "supervised/*": "per epoch: loss of Eq. 3 without meta-learning",
    "study/*": "mean of a metric over people, study/<metric>/<condition>; x is the condition, (a) to (i) as 1 to 9; "
    "rates are shares from 0 to 1, mean_smash_speed is in m/s, mean_disagreement in N, ratings are from 1 to 7",
    "means/text_summary": "the same as a table",
    "force/*": "histogram of the size of the force in N, every tick of everybody's game, by condition",
    "w_*": "histogram of a weight (w_unc_optimal, w_unc_user, w_sim), ditto, by condition that uses it",
    "figure/*": "pictures of a study: figure6",
    "score/*": "what a finished run is judged by, the metrics of the HPARAMS page: shares of decided rounds, of a "
    "league's last generation against a script (against_striker) and an older one (generation_0); mean_smash_speed in "
    "m/s; losses of Eq. 3, and rmse in units of action; how many of the paper's findings are replicated",
    "card/text_summary": "the resolved configuration",
    "names/text_summary": "this table",
}
LAYOUT = {
    "League": {
        "share of rounds won against scripts": ["Multiline", [r"win_rate_against/[a-z]+$"]],
        "share of rounds won against generations": ["Multiline", [r"win_rate_against/\d+$"]],
        "STD of actions, in units of action": ["Multiline", [r"update/std$"]],
        "KL divergence of an update, and gain": ["Multiline", [r"update/(kl|gain)$"]],
        "share of TRPO's full step": ["Multiline", [r"update/step$"]],
        "loss of the critic": ["Multiline", [r"update/critic_loss$"]],
    },
    "League report": {
        "ratings, in Elo points": ["Multiline", [r"rating/.*"]],
        "STD by situation, in units of action": ["Multiline", [r"std/.*"]],
        "share of shots saved": ["Multiline", [r"save_rate/.*"]],
    },
    "User models": {
        "loss of Eq. 3, with meta-learning": ["Multiline", [r"maml/loss$", r"maml/loss_before$"]],
        "loss of Eq. 3, without": ["Multiline", [r"supervised/loss$"]],
    },
    "Study: conditions (a) to (i) from left to right": {
        "share of rounds won": ["Multiline", [r"study/win_rate/.*"]],
        "mean smash speed, in m/s": ["Multiline", [r"study/mean_smash_speed/.*"]],
        "share of shots stopped": ["Multiline", [r"study/defense_rate/.*"]],
        "mean disagreement, in N": ["Multiline", [r"study/mean_disagreement/.*"]],
        "ratings by proxy, from 1 to 7": ["Multiline", [r"study/(helpfulness|naturalness|controllability|comfort)/.*"]],
    },
}
STAMPED = re.compile(r"(events\.out\.tfevents\.)(\d{10})(\..*)")
# how a run is run, not what it is
NOT_SETTINGS = ("resume", "threads", "device", "pictures_every")
SCORES = "scores"  # the folder of what the HPARAMS page shows


def flatten_settings(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A tree of settings as dotted names; lists as they are written on the command line."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flatten_settings(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = json.dumps(value).replace(" ", "") if isinstance(value, list) else value
    return leaves


class Short(yaml.SafeDumper):
    """Writes lists in one line, as the yaml files of `conf/` do."""


Short.add_representer(list, lambda dumper, items: dumper.represent_sequence("tag:yaml.org,2002:seq", items, True))


def verbatim(text: str) -> str:
    """Markdown that shows a text as it is, line by line."""
    return "".join(f"    {line}\n" for line in text.splitlines())


def log_run_header(writer: SummaryWriter, cfg: DictConfig) -> None:
    """Log what a run is, once, as it begins: the layout of the CUSTOM SCALARS page, card and names on the TEXT page."""
    writer.add_custom_scalars(LAYOUT)
    tree = OmegaConf.to_container(cfg, resolve=True)
    writer.add_text("card", verbatim(yaml.dump(tree, Dumper=Short, sort_keys=False, width=100)))
    rows = "".join(f"| `{tag.removesuffix('/text_summary')}` | {what} |\n" for tag, what in VOCABULARY.items())
    writer.add_text("names", f"| name | what it is |\n|---|---|\n{rows}")


def add_picture(writer: SummaryWriter, tag: str, content: bytes, step: int) -> None:
    """Log a picture as it is, a PNG or an animated GIF.

    `SummaryWriter.add_image` would encode it anew, and its `add_video` makes a GIF with a moviepy of before version 2.
    """
    with Image.open(io.BytesIO(content)) as picture:
        width, height = picture.size
    image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=content)  # 3: RGB
    writer._get_file_writer().add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)


def log_final_scores(folder: Path | str, cfg: DictConfig, scores: Mapping[str, float], step: int = 0) -> None:
    """Log what came of a finished run, as `score/*` and on the HPARAMS page beside all its settings.

    What the page shows is left to TensorBoard to gather: the settings of all runs, those that differ first, and every
    scalar in their folders. So the scores have a folder to themselves, and there is no description of an experiment,
    of which the page would take the first that it comes by, and show of the runs of other commands no more than that.

    Args:
        folder: of the run.
        scores: by name; what is not a number is left out.
    """
    known = {f"score/{name}": float(value) for name, value in scores.items() if value == value}
    settings = {
        name: value if isinstance(value, bool | int | float | str) else json.dumps(value)
        for name, value in flatten_settings(OmegaConf.to_container(cfg, resolve=True)).items()
        if name.rpartition(".")[2] not in NOT_SETTINGS
    }
    with open_writer(tensorboard_dir(folder) / SCORES, 0) as writer:  # 0: a run that ends again has its scores once
        for summary in hparams(settings, known)[1:]:  # without the description
            writer._get_file_writer().add_summary(summary)
        for name, value in known.items():
            writer.add_scalar(name, value, step)


def tensorboard_dir(folder: Path | str) -> Path:
    """Where a run's event files lie."""
    return Path(folder) / "tensorboard"


def open_writer(folder: Path, purge_step: int) -> SummaryWriter:
    """Go on writing scalars; what was logged from `purge_step` on, by a run that was killed, is struck out.

    TensorBoard reads files in the order of the seconds in their names, and strikes out of what it has read before.
    Files that are not older than now, because the clock was set back or went on no second, are given older names.
    """
    now, stamped = int(time.time()), sorted(path for path in folder.glob("events*") if STAMPED.fullmatch(path.name))
    for place, path in enumerate(stamped):
        prefix, second, rest = STAMPED.fullmatch(path.name).groups()
        oldest_left = now - (len(stamped) - place)
        if int(second) > oldest_left:
            path.rename(path.with_name(f"{prefix}{oldest_left:010d}{rest}"))
    threading.excepthook = _said_once
    return SummaryWriter(str(folder), purge_step=purge_step)


def _said_once(args: threading.ExceptHookArgs) -> None:
    """Say what has ended a thread, unless it is TensorBoard's: whoever writes or flushes next is given its error."""
    if not (isinstance(args.exc_value, OSError) and type(args.thread).__module__.startswith("tensorboard.")):
        threading.__excepthook__(args)
