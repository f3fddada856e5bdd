"""How the arm rings after a move: its modes, the time to rest, moves that leave no ring."""
