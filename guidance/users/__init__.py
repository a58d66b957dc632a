"""Simulated people: who they are, how they see, decide, move, and answer a force, and what they would tick."""

from guidance.users.people import Users
from guidance.users.population import Population
from guidance.users.sampling import personal_streams, sample_people, training_people

__all__ = ["Population", "Users", "personal_streams", "sample_people", "training_people"]
