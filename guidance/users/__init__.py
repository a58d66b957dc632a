"""Simulated people: who they are, how they see, decide, move, and answer a force, and what they would tick."""

from guidance.users.mentors import NO_MENTORS, Mentors, load_mentors
from guidance.users.people import Users
from guidance.users.population import Population
from guidance.users.sampling import personal_streams, sample_people, training_people

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
