"""The forces and the meta-learning of this package on other tasks than air hockey."""
