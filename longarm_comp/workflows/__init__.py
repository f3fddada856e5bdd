"""What each command does, callable from Python: one file a workflow, no command line in it."""
