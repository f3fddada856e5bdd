"""Studies that print figures of the documentation; not installed with the package."""
