"""Falsification: an optimiser searches for simulated runs that violate a specification."""
