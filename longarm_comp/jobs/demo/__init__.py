"""The whole loop over the real graph on the simulated arm: `longarm demo`."""
