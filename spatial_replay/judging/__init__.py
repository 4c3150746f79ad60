"""Judging episodes: verdicts next to success labels, with rates, intervals and reasons.

`labels` reads labels. `judgement` compares them with the rows of a batch. `sentences` describes the result.
`statistics` has the numbers, and `writers` makes pages.
"""
