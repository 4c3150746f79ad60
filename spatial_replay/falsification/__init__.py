"""Falsification: simulated runs that violate a specification, found by an optimiser rather than by chance."""
