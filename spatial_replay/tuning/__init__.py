"""Tuning of constants and learning of specifications, so that good runs and bad runs differ."""
