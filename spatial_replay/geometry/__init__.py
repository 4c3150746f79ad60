"""Footprints and the distances between them; knows no formulas."""
