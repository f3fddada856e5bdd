"""Straight-line code from the package's own Python: Python text, NumPy, LLVM."""
