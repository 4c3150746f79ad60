"""Tuning and learning: constants, or a whole specification, with which good runs and bad ones differ."""
