"""Compensation: targets become joints, by pseudo-targets; the running arm, and the drift test."""
