"""Comparing: which edit changed a verdict, where two runs part, and the smallest log that shows a verdict."""
