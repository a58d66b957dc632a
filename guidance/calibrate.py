"""Set what may be set before a study, from unguided play of the nine training users and nothing else.

    python -m guidance.calibrate

The opponent: the newest generation against which the nine win 35 to 55 % of their rounds, which last 12 to 25 s.
T_low and T_high of UT (Eq. 5): so that the mean W_unc in that play is the paper's (section 6.1).
K of Eq. 4, for T_lookahead: the largest that leaves the hands of 95 % of the nine damped. The state holds one's own
paddle, so UPHG's target moves ahead of the hand by a lead L that grows with T_lookahead, and its spring pushes along
the motion by K L v: negative damping. Stable is K L <= 0.8 (B + b), B the damping of the relaxed arm, b the device's.

Writes calibration.yaml, the values and what they rest on, into its run folder. A value takes effect when it is copied
into conf/: calibration never changes a study by itself.
"""

from pathlib import Path

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from scipy.optimize import brentq
from torch import Tensor

from airhockey_marl.building import build
from airhockey_marl.cli import InputError, ProgressBar, command, input_errors, require_counts, require_numbers
from airhockey_marl.files import write_text
from airhockey_marl.inference import steady
from airhockey_marl.league import League
from airhockey_marl.match import Player, play_rounds
from airhockey_marl.table import Table
from guidance.conditions import ADAPTED, OPTIMAL
from guidance.forces import uncertainty_weight
from guidance.games import Games, no_force, play_games, streams
from guidance.maml import forward_each
from guidance.models import Models
from guidance.provenance import chosen_models
from guidance.users import Users, load_mentors, training_people
from guidance.users.reaction import check_variant

NEW_ROUND = 0.1  # m, further than a paddle moves in a tick: it has been put back
OPPONENT_TRIAL, THRESHOLD_TRIAL = 1000, 2000  # in the seeds, where a study has the number of its condition


@command("calibrate")
def main(cfg: DictConfig) -> None:
    with input_errors():
        require_counts(cfg, "threads", "every")
        check_variant(cfg.users.variant)
        require_counts(cfg, "games", least=2)  # UA from one, uncertainty in the others
        require_counts(cfg, "seed", least=0)
        require_numbers(cfg, "w_unc.optimal", "w_unc.user", "low_over_high", at_most=0.999)
        require_numbers(cfg, "stability.rule.share", "stability.rule.of_people", at_most=1.0)
        require_numbers(cfg, "stability.rule.step")
        require_numbers(cfg, "guidance.lookahead", least=0.0, at_most=1.0)
        if not all(isinstance(seconds, float) and 0 <= seconds <= 1 for seconds in cfg.stability.lookaheads):
            raise InputError(f"stability.lookaheads = {cfg.stability.lookaheads} must be numbers from 0 to 1")
        people = training_people(cfg.seed, build(cfg.users.population))
        mentors = load_mentors(cfg.users.mentors)
        protocol = build(cfg.study, familiarisation=0)
        models = chosen_models(cfg)
        league = League.load(cfg.models.opponents)
        if cfg.opponent is not None:
            league.generation(cfg.opponent)
    torch.set_num_threads(cfg.threads)
    progress = ProgressBar()

    def play(generation: int, trial: int, demonstrations: bool = False) -> Games:
        """Each of the nine plays `games` games: rows are person by person."""
        keys = [
            [streams(cfg.seed, [u], trial + g, p) for u in range(len(people)) for g in range(cfg.games)] for p in (0, 1)
        ]
        minds, serves = (np.concatenate(part) for part in keys)
        seated = Users(np.repeat(people, cfg.games), minds, Table(), cfg.users.variant, mentors)
        opponent = steady(league.player(generation))
        return play_games(seated, opponent, no_force, protocol, Table(), serves, demonstrations)

    trials = {}
    candidates = [cfg.opponent] if cfg.opponent is not None else range(0, len(league), cfg.every)
    for i, generation in enumerate(candidates):
        games = play(generation, OPPONENT_TRIAL)
        trials[generation] = {
            "win_rate": round(float(np.nanmean(games.results["win_rate"])), 3),
            "round_seconds": round(float(games.seconds.sum() / games.rounds.sum()), 1),
        }
        progress("opponents", (i + 1) / len(candidates))
    opponent = cfg.opponent if cfg.opponent is not None else fitting_opponent(trials, cfg.win_rate, cfg.round_seconds)

    progress("thresholds", 0.0)
    states = play(opponent, THRESHOLD_TRIAL, demonstrations=True).demonstrations
    thresholds = {
        name: threshold(std, cfg.w_unc[name], cfg.low_over_high)
        for name, std in predicted_std(models, states, cfg.games, cfg.guidance.lookahead).items()
    }
    progress("thresholds", 1.0)
    progress.close()
    leads = {
        seconds: leads_of(models, states, cfg.games, seconds)
        for seconds in sorted({*cfg.stability.lookaheads, cfg.guidance.lookahead})
    }
    damping = people["stiffness"] * people["damping_time"] + people["device_damping"]
    stable = {
        seconds: {
            "lead": round(float(lead.mean()), 4),
            "stiffness": stiffest(lead, damping, **cfg.stability.rule),
            "optimal_wins": round(optimal_wins(models, steady(league.player(opponent)), seconds, cfg.seed), 3),
        }
        for seconds, lead in leads.items()
    }
    found = {
        "opponent": opponent,
        "stiffness": stable[cfg.guidance.lookahead]["stiffness"],
        "thresholds": thresholds,
        "evidence": {"opponents": trials, "stable": stable, "models": models.hashes},
    }
    text = OmegaConf.to_yaml(OmegaConf.create(found))
    write_text(Path(HydraConfig.get().runtime.output_dir) / "calibration.yaml", text)
    print(text)


def fitting_opponent(trials: dict[int, dict[str, float]], win_rate: list[float], round_seconds: list[float]) -> int:
    """The newest generation within both ranges.

    Raises:
        InputError: there is none.
    """
    fitting = [
        generation
        for generation, trial in trials.items()
        if win_rate[0] <= trial["win_rate"] <= win_rate[1]
        and round_seconds[0] <= trial["round_seconds"] <= round_seconds[1]
    ]
    if not fitting:
        raise InputError(f"no generation has win_rate in {win_rate} and round_seconds in {round_seconds}: {trials}")
    return max(fitting)


@torch.no_grad()
def leads_of(
    models: Models, demonstrations: list[tuple[Tensor, Tensor]], games: int, lookahead_seconds: float
) -> np.ndarray:
    """By how much UPHG's target (UA) leads the hand, in s: the slope of their distance over the hand's velocity.

    Args:
        demonstrations: person by person, `games` games each; the first of each is for UA.

    Returns:
        (people,)
    """
    adapted, tick, leads = models.adapted_to(demonstrations[::games]), Table().tick, []
    for person in range(len(adapted)):
        distances, velocities = [], []
        for observation, action in demonstrations[person * games + 1 : (person + 1) * games]:
            anticipated = models.anticipated(ADAPTED, observation[1:], lookahead_seconds)
            target = forward_each(models.meta, adapted[person : person + 1], anticipated[None])[0][0]
            hand, velocity = action[:-1], action.diff(dim=0) / tick
            in_one_round = (observation.diff(dim=0)[:, :2].norm(dim=1) < NEW_ROUND)[:, None]
            distances.append((target - hand) * in_one_round)
            velocities.append(velocity * in_one_round)
        distance, velocity = torch.cat(distances), torch.cat(velocities)
        leads.append(((distance * velocity).sum() / velocity.square().sum()).item())
    return np.array(leads)


def optimal_wins(models: Models, opponent: Player, lookahead_seconds: float, seed: int) -> float:
    """Share of decided rounds that the optimal action model itself wins, asked every tick about the looked-ahead state.

    No rule rests on it. But it says what OAHG can hope for: an action that is right in a while is not right now.
    """

    def looking_ahead(observation: Tensor) -> Tensor:
        return models.optimal(models.anticipated(OPTIMAL, observation, lookahead_seconds))[0]

    won, lost, _ = play_rounds(looking_ahead, opponent, 100, 4, seed, decision_ticks=1).sum(axis=0)
    return float(won / (won + lost))


def stiffest(lead: np.ndarray, damping: np.ndarray, share: float, of_people: float, step: float) -> float:
    """The largest K, a multiple of `step` in N/m, for which K lead <= share * damping holds for so many of the people.

    Args:
        lead: (people,) s.
        damping: (people,) N s/m, of arm and device.
    """
    each = np.where(lead > 0, share * damping / np.maximum(lead, 1e-12), np.inf)
    return float(step * np.floor(np.quantile(each, 1 - of_people, method="lower") / step))


@torch.no_grad()
def predicted_std(
    models: Models, demonstrations: list[tuple[Tensor, Tensor]], games: int, lookahead_seconds: float
) -> dict[str, Tensor]:
    """STD (ticks, 2) of the optimal and of the adapted user model; each person's first game is for UA and left out.

    Args:
        demonstrations: person by person, `games` games each.
    """
    adapted = models.adapted_to(demonstrations[::games])
    optimal, user = [], []
    for i, (observation, _) in enumerate(demonstrations):
        if i % games:
            optimal.append(models.optimal(models.anticipated(OPTIMAL, observation, lookahead_seconds))[1])
            anticipated = models.anticipated(ADAPTED, observation, lookahead_seconds)
            user.append(forward_each(models.meta, adapted[i // games : i // games + 1], anticipated[None])[1][0])
    return {"optimal": torch.cat(optimal), "user": torch.cat(user)}


def threshold(std: Tensor, mean_weight: float, low_over_high: float) -> dict[str, float]:
    """T_low and T_high for which the mean W_unc (Eq. 5) of STDs (n, 2) is `mean_weight`."""
    squared = std.double().square().sum(-1)

    def excess(log_high: float) -> float:
        high = float(np.exp(log_high))
        return uncertainty_weight(std.double(), low_over_high * high, high).mean().item() - mean_weight

    ends = np.log(squared.min().item() / 2), np.log(squared.max().item() / low_over_high * 2)
    high = float(np.exp(brentq(excess, *ends)))
    weight = uncertainty_weight(std.double(), low_over_high * high, high)
    return {
        "low": float(f"{low_over_high * high:.4g}"),
        "high": float(f"{high:.4g}"),
        "mean_w_unc": round(weight.mean().item(), 3),
        "sd_w_unc": round(weight.std().item(), 3),
    }


if __name__ == "__main__":
    main()
