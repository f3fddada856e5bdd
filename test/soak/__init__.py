"""Soak test: hours of targets at a steady rate with random faults; every answer is checked."""
