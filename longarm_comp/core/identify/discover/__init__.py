"""The search for effects without a name: place, component and function."""
