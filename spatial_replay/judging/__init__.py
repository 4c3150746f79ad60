"""Judging episodes: verdicts next to success labels, with rates, intervals and reasons.

`labels` reads labels. `judgement` compares labels with the rows of a batch, and `pairs` compares two
judgements. `stages` has the progress of episodes, and `statistics` the tests. `sentences` and `writers` make
texts and files.
"""
