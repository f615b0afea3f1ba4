"""Planners: where to go next."""
