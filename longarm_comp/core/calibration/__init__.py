"""Fits a model to rows: placement, geometry, noise, and the uncertainty that stays."""
