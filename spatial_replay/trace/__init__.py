"""Samples as columns, with a cache of their measurements."""
