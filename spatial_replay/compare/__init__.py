"""Comparing: which edit changed a verdict, where two runs part, and the smallest log that shows a verdict.

specifications   two versions over one log: `trees` finds the edits, `edit_cause` the one that mattered
runs             two logs: `alignment` pairs their samples, then `movement`, results and decisions
clips            `clip_window` finds the window, which is written as a log
"""
