"""Chooses the poses whose measurement gives the most information."""
