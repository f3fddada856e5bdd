"""From a target to joints: the pseudo-target, results, the running arm, drift."""
