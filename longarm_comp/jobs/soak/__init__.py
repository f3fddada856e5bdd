"""Hours of targets at a steady rate, with random faults, and books of what came of each."""
