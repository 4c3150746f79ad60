"""Robustness of formulas on traces, with deciding atoms: online, offline, and by the paper's definition."""
