"""Simulated worlds: bodies with contact, a robot that moves them, and samples of their poses."""
