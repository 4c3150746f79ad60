"""Replay: a log and specifications in, verdicts and an annotated log out.

`selection` picks the samples, `engine` evaluates them and writes the log, `document` the JSON. `loaded_log`
evaluates a log in memory again, with what `specification_files` reads when it is saved, and plays it.
"""
