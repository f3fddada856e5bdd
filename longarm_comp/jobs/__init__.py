"""Jobs on top of the running graph: collect, record, verify, apply, demo."""
