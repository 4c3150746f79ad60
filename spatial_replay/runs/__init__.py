"""Runs: a world, whoever moves what is in it, and the log of what happens."""
