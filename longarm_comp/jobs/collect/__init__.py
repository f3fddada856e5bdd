"""`longarm collect`: the job, its plan looked at beforehand, what it shows while it runs."""
