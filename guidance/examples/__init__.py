"""The forces and the meta-learning of this package on another task than air hockey."""
