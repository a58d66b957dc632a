"""Make one person's own user prediction model from their recorded play: user adaptation (UA, Eq. 1).

    airhockey adapt data=outputs/play/<date>/<time>               what you have played without guidance
    airhockey adapt data=outputs/lab/records participant=P01      one of several people
    airhockey evaluate models.user=outputs/adapt/<date>/<time>/user.safetensors

Takes the meta-learned model one step along the person's play, all but the last part, on which losses before and after
are measured. Writes user.safetensors, for `models.user` of any command, and card.json. Neither names the person, unless
`keep_label=true`, and nothing that is typed is kept. The columns of a table of your own: guidance/user_model/README.md.
"""

import time

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.config import InputError
from airhockey_marl.experiment.files import sha256, write_json
from airhockey_marl.experiment.run_folder import output_folder

MODEL, CARD = "user.safetensors", "card.json"
SHORTEST = 50  # ticks, 1 s; shorter pieces are left out


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "steps")
    require_numbers(cfg, "hold_out", least=0.05, at_most=0.5)
    if cfg.inner_lr is not None:
        require_numbers(cfg, "inner_lr")


def main(cfg: DictConfig) -> None:
    import torch

    from airhockey_marl.envs.physics import TableSpec
    from guidance.study.models import check_predictor, load_user_model, save_user_model
    from guidance.user_model.data import MIN_DEMONSTRATION_TICKS, Recordings
    from guidance.user_model.loss import prediction_loss
    from guidance.user_model.maml import parameters
    from guidance.user_model.recordings import read_recordings
    from guidance.user_model.training import adapt_to_user

    folder, table = output_folder(cfg), TableSpec()
    with report_input_errors():
        check_predictor(cfg.guidance.predictor)
        model, known = load_user_model(cfg.models.meta)
        if "inner_lr" not in known:
            raise InputError(f"models.meta = {cfg.models.meta} was not meta-learned: it has no inner_lr")
        if (folder / MODEL).exists():
            raise InputError(f"hydra.run.dir = {folder} must be a folder without {MODEL}: a model is not replaced")
        recordings, data = read_recordings(cfg.data, SHORTEST)
        label = choose_person(recordings.people, cfg.participant)
        own = Recordings({label: recordings.people[label]})
        ticks = sum(len(action) for _, action in own.people[label])
        if ticks < MIN_DEMONSTRATION_TICKS:
            raise InputError(f"data = {cfg.data} must have {MIN_DEMONSTRATION_TICKS} ticks of {label}, and has {ticks}")
    lr, ahead = cfg.inner_lr or known["inner_lr"], known.get("ahead_s", 0.0)
    parts = (part.ahead(ahead, table).people[label] for part in own.split(cfg.hold_out))
    demonstration, test = (tuple(map(torch.cat, zip(*pieces, strict=True))) for pieces in parts)

    @torch.no_grad()
    def measure() -> dict[str, float]:
        mean, std = model(test[0])
        error = (test[1] - mean).square().sum(-1).mean().sqrt()
        return {"loss": round(prediction_loss(mean, std, test[1]).item(), 4), "rmse": round(error.item(), 4)}

    before = measure()
    states, actions = (part[None] for part in demonstration)
    adapted = adapt_to_user(model, parameters(model), states, actions, lr, cfg.steps)[0]
    model.load_state_dict(adapted.flatten_keys(".").to_dict(), strict=False)  # buffers stay
    after = measure()
    if not abs(after["loss"]) < float("inf"):
        raise FloatingPointError(f"inner_lr = {lr}, steps = {cfg.steps}: the adapted model's loss is {after['loss']}")
    facts = {
        "ahead_s": ahead,
        "adaptation": {
            "inner_lr": lr,
            "steps": cfg.steps,
            "ticks": len(demonstration[1]),
            "data_sha256": data["sha256"],
        },
        **({"participant": label} if cfg.keep_label else {}),
    }
    save_user_model(folder / MODEL, model, facts)
    card = {
        "model": f"{MODEL}: one person's user prediction model (UA, Eq. 1)",
        **facts,
        "meta_sha256": sha256(cfg.models.meta),
        "held_out": f"the last {cfg.hold_out:.0%} of the person's ticks",
        "on_held_out": {"ticks": len(test[1]), "before": before, "after": after},
        "date": time.strftime("%Y-%m-%d"),
    }
    write_json(folder / CARD, card)
    print(f"{len(demonstration[1]) * table.tick:.0f} s of play; on {len(test[1]) * table.tick:.0f} s held out:")
    print(*(f"  {name}: {before[name]:.3f} before, {after[name]:.3f} after" for name in before), sep="\n")
    print(f"models.user={folder / MODEL}")


def choose_person(people: dict, participant: str | None) -> str:
    """The label of the one person, or of the one that `participant` names."""
    names = ", ".join(people)
    if participant is None and len(people) > 1:
        raise InputError(f"participant must be chosen, data has {len(people)} people: {names[:150]}")
    label = next(iter(people)) if participant is None else str(participant)
    if label not in people:
        raise InputError(f"participant = {label} must be one of {names[:150]}")
    return label
