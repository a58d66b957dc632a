"""The population that simulated people are drawn from: distributions, parameters, sampling."""

from guidance.simulated_users.population.distributions import LogNormal, Proportion, ScaledBeta
from guidance.simulated_users.population.parameters import PARAMETER_TYPES, TRAITS, Population, UtilityRow
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
    "LogNormal",
    "Population",
    "Proportion",
    "ScaledBeta",
    "UtilityRow",
    "personal_streams",
    "sample_people",
    "training_people",
]
