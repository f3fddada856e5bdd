"""Generation of straight-line code from the package's own Python: Python, NumPy, LLVM."""


class Compiled:
    """What this process has compiled to machine code."""

    programs = 0
