"""Learning: a specification from relations that hold in good runs and not in bad ones.

`quantities` are what the runs have in common, `observed` is what is measured of them in a run, `fit` finds
the limits that all good runs keep and the bad ones that they distinguish, `facts` are relations with limits
as text and in words, `choose` picks the few lines worth writing, `learned` is what was found.
"""
