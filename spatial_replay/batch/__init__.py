"""Evaluation of many logs: the cases of a suite give rows of results.

`suite` reads the cases, and `rows` evaluates one log. `run` finds the logs and evaluates them with the
processes of `workers`. `store` keeps rows, and `run_table` compares them. `overview`, `pages`, `junit` and
`github` show them.
"""
