"""Hidden effects: undeclared errors of the true arm and its cameras, each with a dose."""
