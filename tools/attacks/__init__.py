"""Attacks on the program, each a source of cases that a seed determines; `tools/campaign` runs them."""
