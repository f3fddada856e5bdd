"""The job of `longarm collect`: the checks of its plan, the visits, and their progress."""
