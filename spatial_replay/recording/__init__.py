"""Recordings of samples in a log, with the robustness of specifications."""
