"""Jobs on top of the running graph: collect, record, demo, soak."""
