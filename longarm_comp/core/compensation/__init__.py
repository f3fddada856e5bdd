"""Compensation: from a target to joints, by pseudo-targets; the running arm; the drift test."""
