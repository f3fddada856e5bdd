"""The real arm, simulated: exact elastic lines and hidden effects, never the model's physics."""
