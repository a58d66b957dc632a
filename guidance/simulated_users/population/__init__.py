"""The population that simulated people are drawn from: distributions, parameters, sampling."""

from guidance.simulated_users.population.distributions import LogNormal, Proportion, ScaledBeta
from guidance.simulated_users.population.parameters import PARAMETER_TYPES, TRAITS, UTILITY_ROWS, Population
from guidance.simulated_users.population.sampling import (
    USER_PARAMETERS,
    personal_streams,
    sample_people,
    training_people,
)

__all__ = [
    "PARAMETER_TYPES",
    "TRAITS",
    "USER_PARAMETERS",
    "UTILITY_ROWS",
    "LogNormal",
    "Population",
    "Proportion",
    "ScaledBeta",
    "personal_streams",
    "sample_people",
    "training_people",
]
