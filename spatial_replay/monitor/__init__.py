"""The robustness of a formula on a trace, online, offline and by the paper, with the deciding atoms."""
