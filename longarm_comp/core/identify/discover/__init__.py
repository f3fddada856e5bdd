"""Search for effects without a name: place, component and function of what the library leaves."""
