"""Planning by specification: what to move where, and why; knows no robot and no simulator.

Section 5.2 of the paper: progress and constraint sets of an automaton's edge, gradient maps, paths,
Algorithm 1. `Planner` is where to begin.
"""
