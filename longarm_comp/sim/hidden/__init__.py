"""Hidden effects: what is wrong with the true arm and its cameras, each with a dose."""
