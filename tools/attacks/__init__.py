"""Attacks on the program. Each attack draws cases from a seed; `tools/campaign` runs them."""
