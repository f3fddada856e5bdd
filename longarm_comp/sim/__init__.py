"""Simulation of the real arm: exact elastic rods and hidden effects, independent of the model."""
