"""The files that viewers can fetch from a session, by names that lead nowhere else."""

from __future__ import annotations

from spatial_replay.inspection.viewer import LAYOUT
from spatial_replay.replay.tuning import Tuned

_PREFIX = "spatial-replay://"


def asset(tuned: Tuned, uri: str) -> bytes | None:
    """The file of a name: the layout, a specification with its present constants, an automaton for Graphviz.

    Returns:
        None if there is no such file.
    """
    kind, _, name = uri.removeprefix(_PREFIX).partition("/")
    if not uri.startswith(_PREFIX):
        return None
    if (kind, name) == (LAYOUT, ""):
        return tuned.layout.data
    if kind == "specification":
        return {file.filename: file.source.encode() for file in tuned.files}.get(name)
    if kind == "automaton" and name.endswith(".dot"):
        kept = tuned.evaluation.automata_attachments("")
        return {each.name.rpartition("/")[2]: each.data for each in kept}.get(name)
    return None
