"""Traces: samples as columns, with a cache of measurements."""
