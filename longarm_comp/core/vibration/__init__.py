"""The ringing of the arm after a move: its modes, the time to rest, moves that leave no ring."""
