"""The model at work: what sightings of ordinary moves say of it, without a stop."""

LEARNED_SAID = "at work"
"""Part of `kinematics` on /diagnostics that says what was learned at work."""
