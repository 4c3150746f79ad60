"""Specifications as automata: which runs satisfy them, and what is still to be done or to be avoided."""
