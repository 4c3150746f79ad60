"""Footprints and distances between footprints, without any dependence on formulas."""
