"""The arm with its effects: what it predicts, what a parameter does, its file."""
