"""Comparisons: the edit that changed a verdict, differences of two runs, the smallest log with a verdict."""
