"""Generation of machine code from the package's own Python, through LLVM."""


class Compiled:
    """A count of what this process has compiled to machine code."""

    programs = 0
