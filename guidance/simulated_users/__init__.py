"""Simulated users: perception, intention, movement, response to force, and rating proxies. See README.md."""

from guidance.simulated_users.advisors import NO_ADVISORS, Advisors, load_advisors
from guidance.simulated_users.population import (
    Population,
    personal_streams,
    pilot_people,
    sample_people,
    training_people,
)
from guidance.simulated_users.users import SimulatedUsers, load_population

__all__ = [
    "NO_ADVISORS",
    "Advisors",
    "Population",
    "SimulatedUsers",
    "load_advisors",
    "load_population",
    "personal_streams",
    "pilot_people",
    "sample_people",
    "training_people",
]
