"""Benchmarks of speed and accuracy, each with the peer that it is compared with."""
