"""Benchmarks: what is fast, what is accurate, each beside what it is compared with."""
