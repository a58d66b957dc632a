"""Simulated people: who they are, how they see, decide, move, and answer a force, and what they would tick."""

from guidance.simulated_users.advisors import NO_MENTORS, Mentors, load_mentors
from guidance.simulated_users.population import Population, personal_streams, sample_people, training_people
from guidance.simulated_users.users import Users

__all__ = [
    "NO_MENTORS",
    "Mentors",
    "Population",
    "Users",
    "load_mentors",
    "personal_streams",
    "sample_people",
    "training_people",
]
