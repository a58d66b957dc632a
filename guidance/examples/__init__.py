"""The parts of this package at work on other problems than air hockey."""
