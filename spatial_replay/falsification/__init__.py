"""Falsification: simulated runs that violate a specification, found by an optimiser rather than by chance.

`parameters` says what is varied, `simulations` gives the run of a case, `optimiser` chooses cases by the
robustness of earlier ones, `rounds` simulates them and keeps them in a `run_file`, so that a search goes on
where it ended, `failure_search` makes failures smaller and cuts clips, `failures` is what was found.
"""
