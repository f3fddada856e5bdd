"""Chooses the poses that would tell most."""
