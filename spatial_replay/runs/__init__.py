"""Simulated runs, scripted or planned, recorded as logs."""
