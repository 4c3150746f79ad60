"""Which results have an automaton, and what a log keeps of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.compiling import automaton
from spatial_replay.automata.drawing import size_words
from spatial_replay.automata.stored import stored_text
from spatial_replay.errors import NoAutomatonError
from spatial_replay.inspection.specification import ReportedTree
from spatial_replay.logs.sink import Attachment
from spatial_replay.logs.topics import AUTOMATA_PREFIX
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.spec.formula import NamedSpec, Specification

_STORED = ".json"
_MOST_LITERALS = 50_000
"""Of an automaton whose guards have more literals, only what a replay needs is kept."""


@dataclass(frozen=True)
class KeptAutomaton:
    """The automaton of a spec or, for a template, of all its instances.

    Attributes:
        name: the name that the spec is reported under.
        automaton: None if it has none.
        reason: why not.
        details: the same, with the place in the specification and the remedy where those are known.
    """

    name: str
    specification: Specification
    spec: NamedSpec
    automaton: Automaton | None
    reason: str = ""
    details: str = ""

    @property
    def summary(self) -> str:
        """What there is, in a few words."""
        if self.automaton is None:
            return f"none: {self.details or self.reason}"
        return size_words(self.automaton)


def automata_of(
    files: Sequence[Specification],
    trees: Sequence[ReportedTree],
    semantics: Semantics,
    compiled_before: Sequence[Attachment] = (),
    known: Sequence[KeptAutomaton] = (),
) -> list[KeptAutomaton]:
    """The automaton of each tree's spec, one for each of `trees`; instances of a template share theirs.

    Args:
        compiled_before: attachments of a log; an automaton among them is taken where it would take MONA.
        known: automata of specs of these files, which are not compiled again.
    """
    stored = [each.data for each in compiled_before if _is_stored(each)]
    found = {id(each.spec.formula): each for each in known}
    for tree in trees:
        if id(tree.formula) not in found:
            file = files[tree.file]
            spec = next(each for each in file.results if each.formula is tree.formula)
            found[id(tree.formula)] = _kept(tree.name, file, spec, semantics, stored)
    return [found[id(tree.formula)] for tree in trees]


def automata_metadata(automata: Sequence[KeptAutomaton]) -> Mapping[str, str]:
    """For each spec, how large its automaton is, or why there is none."""
    return {each.name: each.summary for each in automata}


def automata_attachments(automata: Sequence[KeptAutomaton], prefix: str) -> list[Attachment]:
    """The automata as files: for a replay, for Graphviz, for tools of automata theory.

    Args:
        prefix: what the names of the specification's own attachments begin with.
    """
    attachments = []
    for each in {kept.name: kept for kept in automata}.values():
        if each.automaton is None:
            continue
        texts = {_STORED: ("application/json", stored_text(each.automaton, each.specification, each.spec))}
        literals = sum(len(cube) for move in each.automaton.transitions for cube in move.guard)
        if literals <= _MOST_LITERALS:
            texts[".dot"] = ("text/vnd.graphviz", each.automaton.to_dot())
            texts[".hoa"] = ("text/plain", each.automaton.to_hoa())
        for suffix, (kind, text) in texts.items():
            attachments.append(
                Attachment(f"{AUTOMATA_PREFIX}{prefix}{each.name}{suffix}", kind, text.encode())
            )
    return attachments


def _is_stored(attachment: Attachment) -> bool:
    return attachment.name.startswith(AUTOMATA_PREFIX) and attachment.name.endswith(_STORED)


def _kept(
    name: str, file: Specification, spec: NamedSpec, semantics: Semantics, stored: Sequence[bytes]
) -> KeptAutomaton:
    if semantics != "ltlf":
        return KeptAutomaton(name, file, spec, None, "an automaton is of the semantics ltlf")
    try:
        return KeptAutomaton(name, file, spec, automaton(file, spec.name, stored=stored))
    except NoAutomatonError as error:
        return KeptAutomaton(name, file, spec, None, error.reason, str(error))
