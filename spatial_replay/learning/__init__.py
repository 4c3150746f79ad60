"""Learning: a specification from relations that hold in good runs and not in bad ones."""
