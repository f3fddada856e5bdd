"""The search for effects without a name, by place, component and function."""
