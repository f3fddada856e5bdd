"""Hidden effects: undeclared errors of the true arm, each with a dose."""
