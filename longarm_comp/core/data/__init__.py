"""Sessions in memory: admission, hold-outs, splits and plans of poses."""
