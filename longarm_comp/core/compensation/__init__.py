"""Targets become joints: pseudo-targets, results, the running arm, drift."""
