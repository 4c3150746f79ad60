"""Mapping files: from the messages of external logs to objects and signals."""
