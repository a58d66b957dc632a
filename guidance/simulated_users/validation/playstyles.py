"""Features of a game, and how well they identify the playstyle and the person."""

import numpy as np
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from airhockey_marl.envs.physics import TableSpec

FEATURES = (
    "depth",  # m, mean x of the paddle while the puck is on the opponent's side
    "depth_spread",  # m
    "width_spread",  # m, of y, likewise
    "lateral_tracking",  # correlation of the paddle's y with the puck's, likewise
    "pressing",  # share of that time within 0.25 m of the half-way line
    "shots_per_minute",
    "shot_speed",  # m/s, mean speed of the puck after a shot
    "shot_speed_spread",  # m/s
    "bank_share",  # of shots that leave at more than 35 degrees from straight on
    "speed",  # m/s, root mean square of the paddle
)
NEAR_HALFWAY = 0.25  # m
STEEP = np.tan(np.radians(35.0))
VELOCITY_CHANGE, FORWARD_SPEED = 0.6, 0.3  # m/s of the puck: least change by a shot, and least vx after it


def shot_velocities(observation: np.ndarray, table: TableSpec) -> np.ndarray:
    """(k, 2) m/s, the puck's velocity after each forward shot of the own paddle, in one stretch of play (ticks, 12)."""
    paddle, puck = observation[..., 0:2], observation[..., 8:12]
    reach = table.puck_radius + table.paddle_radius + 0.05
    change = np.linalg.norm(np.diff(puck[:, 2:], axis=0), axis=-1)
    close = np.linalg.norm(puck[:-1, :2] - paddle[:-1], axis=-1) < reach
    return puck[1:, 2:][(change > VELOCITY_CHANGE) & close & (puck[1:, 2] > FORWARD_SPEED)]


def features(observation: Tensor, table: TableSpec) -> np.ndarray:
    """(n, 10) `FEATURES` of n stretches of play (n, ticks, 12)."""
    rows = []
    for play in observation.numpy().astype(np.float64):
        away = play[:, 8] > 0.0
        x, y = play[away, 0], play[away, 1]
        shots = shot_velocities(play, table)
        speed = np.linalg.norm(shots, axis=-1) if len(shots) else np.zeros(1)
        rows.append(
            [
                x.mean(),
                x.std(),
                y.std(),
                np.corrcoef(y, play[away, 9])[0, 1] if y.std() > 0 else 0.0,
                (x > -NEAR_HALFWAY).mean(),
                len(shots) / (len(play) * table.tick / 60),
                speed.mean(),
                speed.std(),
                (np.abs(shots[:, 1]) > STEEP * shots[:, 0]).mean() if len(shots) else 0.0,
                np.sqrt((play[:, 2:4] ** 2).sum(-1).mean()),
            ]
        )
    return np.array(rows)


def classify_styles(known: np.ndarray, styles: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Styles (m,) of the `unseen` games (m, features) by a linear discriminant fitted to `known` games of `styles`."""
    return make_pipeline(StandardScaler(), LinearDiscriminantAnalysis()).fit(known, styles).predict(unseen)


def identification_rate(first: np.ndarray, second: np.ndarray) -> float:
    """Share of n people whose game in `second` (n, features) is the most similar of all to their game in `first`.

    Distances are in units of the differences within a person.
    """
    within = np.cov((first - second).T) / 2 + 1e-9 * np.eye(first.shape[1])
    whiten = np.linalg.cholesky(np.linalg.inv(within))
    a, b = first @ whiten, second @ whiten
    nearest = np.linalg.norm(a[:, None] - b[None], axis=-1).argmin(axis=1)
    return float(np.mean(nearest == np.arange(len(first))))
