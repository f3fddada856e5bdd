"""Fits a model to rows: placement, geometry, noise, and what stays uncertain."""
