"""What sets the play of people apart: a handful of numbers about a game, and how well they tell who played it."""

import numpy as np
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.validation import CPU, check_arrays, check_tensors

FEATURES = (
    "depth",  # m, mean x of the paddle while the puck is the opponent's
    "depth_spread",  # m
    "width_spread",  # m, of y, likewise
    "follows",  # correlation of the paddle's y with the puck's, likewise
    "presses",  # share of that time within 0.25 m of the half-way line
    "blows_per_minute",
    "blow_speed",  # m/s, mean speed of the puck after a blow
    "blow_speed_spread",  # m/s
    "banks",  # share of blows that leave at more than 35 degrees from straight on
    "speed",  # m/s, root mean square of the paddle
)
NEAR_HALFWAY = 0.25  # m
STEEP = np.tan(np.radians(35.0))
BLOW, FORWARD = 0.6, 0.3  # m/s: a change of the puck's velocity that only a paddle makes, and to the front


def blows(observation: np.ndarray, table: TableSpec) -> np.ndarray:
    """(k, 2) the puck's velocity in m/s after each blow of the own paddle, in one stretch of play (ticks, 12)."""
    check_arrays(observation=(observation, "ticks 12"))
    paddle, puck = observation[..., 0:2], observation[..., 8:12]
    reach = table.puck_radius + table.paddle_radius + 0.05
    change = np.linalg.norm(np.diff(puck[:, 2:], axis=0), axis=-1)
    close = np.linalg.norm(puck[:-1, :2] - paddle[:-1], axis=-1) < reach
    return puck[1:, 2:][(change > BLOW) & close & (puck[1:, 2] > FORWARD)]


def features(observation: Tensor, table: TableSpec) -> np.ndarray:
    """(n, 10) `FEATURES` of n stretches of play (n, ticks, 12)."""
    check_tensors(CPU, observation=(observation, "n ticks 12"))
    rows = []
    for seen in observation.numpy().astype(np.float64):
        away = seen[:, 8] > 0.0
        x, y = seen[away, 0], seen[away, 1]
        hit = blows(seen, table)
        hard = np.linalg.norm(hit, axis=-1) if len(hit) else np.zeros(1)
        rows.append(
            [
                x.mean(),
                x.std(),
                y.std(),
                np.corrcoef(y, seen[away, 9])[0, 1] if y.std() > 0 else 0.0,
                (x > -NEAR_HALFWAY).mean(),
                len(hit) / (len(seen) * table.tick / 60),
                hard.mean(),
                hard.std(),
                (np.abs(hit[:, 1]) > STEEP * hit[:, 0]).mean() if len(hit) else 0.0,
                np.sqrt((seen[:, 2:4] ** 2).sum(-1).mean()),
            ]
        )
    return np.array(rows)


def told_apart(known: np.ndarray, styles: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """The styles (m,) that a linear discriminant, taught by `known` (n, features) of `styles`, sees in `unseen`."""
    check_arrays(known=(known, "n k"), unseen=(unseen, "m k"))
    if np.shape(styles) != (len(known),):
        raise ValueError(f"styles: shape {np.shape(styles)}, must be {(len(known),)}")
    return make_pipeline(StandardScaler(), LinearDiscriminantAnalysis()).fit(known, styles).predict(unseen)


def recognized(one: np.ndarray, another: np.ndarray) -> float:
    """Share of n people whose game in `another` (n, features) is, of all, the most like theirs in `one`.

    Distances are those of linear discriminants: by how much people differ from each other, rather than from themselves.
    """
    check_arrays(one=(one, "n k"), another=(another, "n k"))
    within = np.cov((one - another).T) / 2 + 1e-9 * np.eye(one.shape[1])
    whiten = np.linalg.cholesky(np.linalg.inv(within))
    a, b = one @ whiten, another @ whiten
    nearest = np.linalg.norm(a[:, None] - b[None], axis=-1).argmin(axis=1)
    return float(np.mean(nearest == np.arange(len(one))))
