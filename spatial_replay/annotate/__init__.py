"""Evaluations as messages that viewers draw: robustness, events, scene, automaton, layout."""
