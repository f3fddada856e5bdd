"""Sessions in memory: admission, hold-outs, plans of poses."""
