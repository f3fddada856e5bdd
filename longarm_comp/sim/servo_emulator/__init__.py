"""Emulated servo buses on a pseudo-terminal. They share no code with the real driver."""
