"""The model at work, which learns from sightings of ordinary moves, without a stop."""

LEARNED_SAID = "at work"
"""The entry under `kinematics` on /diagnostics that says what was learned at work."""
