"""Replay: a log and specifications in, verdicts and an annotated log out.

`selection` picks the samples, `engine` evaluates them and writes the log, `document` the JSON. `loaded_log`
evaluates a log in memory again and plays it. `specification_files` reads saved specifications again.
"""
