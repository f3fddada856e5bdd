"""The work of each command as Python functions, one file per workflow."""
