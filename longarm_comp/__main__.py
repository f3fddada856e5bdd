"""``python -m longarm_comp`` is the same program as ``longarm``."""

from longarm_comp.cli import main

if __name__ == "__main__":
    main()
