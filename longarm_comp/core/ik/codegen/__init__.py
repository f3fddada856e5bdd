"""Generation of straight-line code from the package's own Python: Python, NumPy, LLVM."""
