"""Replay: evaluate specifications over a log, and write verdicts and an annotated log.

`selection` chooses the samples, `engine` evaluates them and writes the log, and `document` writes the JSON.
`loaded_log` evaluates a log in memory repeatedly and plays it. `specification_files` reads saved
specifications again.
"""
