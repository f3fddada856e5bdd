"""One step of closing the loop each: fit, noise, structure, trace, confirm, next poses."""
