"""Mapping files, which turn messages of external logs into objects and signals."""
