"""What a person remembers from tick to tick, apart from the arm and what was seen, felt and done lately."""

import numpy as np

# One record a person. Seconds, meters of the hand and newtons, unless said otherwise.
USER_STATE = np.dtype(
    [
        ("age", np.int64),  # ticks since the round began
        # intention
        ("told", np.int64),  # the intention that an experimenter asks for, or -1
        ("intention", np.int64),
        ("next_intention", np.int64),  # decided, not yet effective
        ("switch_left", np.float64),  # until it is; < 0: nothing decided
        ("dwell_left", np.float64),  # until the person reconsiders without being made to
        ("situation", np.int64),
        ("threatened", np.int64),  # expects the puck in the own goal
        ("aim", np.float64),  # where in the goal's mouth, or off the middle of it at home, in -1..1
        ("depth", np.float64),  # how far before or behind the usual place, in -1..1
        ("sees_bounces", np.int64),  # anticipates the walls for this shot
        ("strike_left", np.float64),  # until the planned contact; inf: none planned
        # the errors of this plan's percept, each N(0, 1)
        ("speed_error", np.float64),
        ("heading_error", np.float64),
        ("bounce_error", np.float64),
        # plan
        ("plan_left", np.float64),  # until the next plan
        ("goal_x", np.float64),  # own goal of the hand, before any sharing
        ("goal_y", np.float64),
        ("noise_left", np.float64),  # until the motor noise is drawn again
        ("noise_along", np.float64),  # share of speed
        ("noise_across", np.float64),
        ("tremor_x", np.float64),  # m/s
        ("tremor_y", np.float64),
        # answer to the force
        ("co_contraction", np.float64),  # 0..1
        ("push_x", np.float64),
        ("push_y", np.float64),
        ("trust", np.float64),  # in the force's goals, 0..1
        ("partner_x", np.float64),  # the goal read from the force
        ("partner_y", np.float64),
    ]
)
