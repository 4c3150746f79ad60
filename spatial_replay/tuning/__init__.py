"""Tuning: the constants with which good runs satisfy a specification and bad ones do not."""
