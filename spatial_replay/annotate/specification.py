"""Specifications in a log: their texts, and the trees of their results in /spatial/specification."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import attrgetter
from pathlib import PurePath
from typing import TYPE_CHECKING, NamedTuple

from spatial_replay.errors import SpecificationError
from spatial_replay.logs.messages import Attachment
from spatial_replay.monitor.stream import Instance
from spatial_replay.spec import format_specification, parse_specification
from spatial_replay.spec.checks import with_numbers
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Atom, Formula, Specification, iter_nodes, operator_of
from spatial_replay.spec.relations import RELATION_NAMES, used_modules
from spatial_replay.spec.tokens import written_name
from spatial_replay.spec.walks import Unit, iter_atoms, per_second, units_of
from spatial_replay.text import names_of, plain_unit

if TYPE_CHECKING:
    from spatial_replay.automata.automaton import Automaton
    from spatial_replay.logs.schemas.Specification_pb2 import SpecificationResult

DIMENSIONLESS = "1"
MIXED = "mixed"
FOOTPRINT_UNITS = ""

_DEFINED = re.compile(r"^\s*def\s+(\w+)", re.MULTILINE)
_QUANTIFIER = re.compile(r"[(\s]*(forall|exists)\b")
_CALL = re.compile(r"[(\s]*(\w+)\s*\(")


class ReportedTree(NamedTuple):
    """One result with the tree of its nodes, whose numbers are in /spatial/robustness.

    Attributes:
        name: reported name of the result.
        object: object of a template's instance, or None.
        file: index of the result's specification among the files.
        requirement: id of the result's requirement, or None.
        sentence: title of the result's requirement, or None.
        parameter: name of the template's parameter, or None.
    """

    name: str
    object: str | None
    file: int
    formula: Formula
    requirement: str | None = None
    sentence: str | None = None
    parameter: str | None = None

    @property
    def title(self) -> str:
        """Name of the result for readers, such as "REQ-12 calm(bike)"."""
        title = self.name if self.object is None else f"{self.name}({self.object})"
        return title if self.requirement is None else f"{self.requirement} {title}"

    def is_called(self, name: str) -> bool:
        """Return whether a name is the title of this result, with or without the requirement's id."""
        title = self.name if self.object is None else f"{self.name}({self.object})"
        return name in names_of(title, self.requirement)

    def with_object_name(self, text: str) -> str:
        """Return a text about the formula, with the object instead of the template's parameter."""
        if self.parameter is None or self.object is None:
            return text
        parameter = re.escape(self.parameter)
        name = written_name(self.object, RELATION_NAMES)
        return re.sub(rf'(?<![\w"]){parameter}(?![\w"])', lambda _: name, text)

    def written_texts(self, source: str) -> list[str]:
        """Return the text of each node as the file writes it, with the object instead of the parameter.

        Nodes in the body of a `def`, and nodes of a quantifier for each of its objects, have no text of their
        own in the file. Such nodes get canonical texts.

        Args:
            source: text of the file.
        """
        texts, spans = [], []
        is_quantifier: list[bool] = []
        for _, parent, node in iter_nodes(self.formula):
            spans.append(node.span)
            source_text = " ".join(source[node.span.start : node.span.end].split())
            is_bound = parent is not None and is_quantifier[parent]
            is_quantifier.append(is_bound or _QUANTIFIER.match(source_text) is not None)
            is_expanded = parent is not None and spans[parent] == node.span
            text = "" if is_expanded or is_bound else source_text
            texts.append(self.with_object_name(text or format_formula(node)))
        return texts

    def calls(self, source: str) -> dict[int, str]:
        """Return the text of each node that is a call of a `def`, as the file writes it, by id."""
        nodes, spec_text = list(iter_nodes(self.formula)), self.written_texts(source)
        spans, defined_names = [node.span for _, _, node in nodes], set(_DEFINED.findall(source))
        # the parser gives the body of a `def` the span of its call
        expanded_ids = {
            identifier
            for identifier, parent, _ in nodes
            if parent is not None and spans[parent] == spans[identifier]
        }
        call_parents = {parent for identifier, parent, _ in nodes if identifier in expanded_ids}
        return {
            identifier: spec_text[identifier]
            for identifier, _, node in nodes
            if node.name is None
            and identifier not in expanded_ids
            and (identifier in call_parents or _is_call(node, spec_text[identifier], defined_names))
        }


def _is_call(node: Formula, written_text: str, defined_names: Collection[str]) -> bool:
    """Return whether an atom was written as a call of one of these `def` names."""
    call = _CALL.match(written_text) if isinstance(node, Atom) else None
    return call is not None and call[1] in defined_names


def reported_trees(
    files: Sequence[Specification], instances: Sequence[Sequence[Instance]]
) -> list[ReportedTree]:
    """Return the trees of all results. Specs with equal names have their file's stem as prefix.

    Args:
        instances: instances of each file, in the order of evaluation.
    """
    spec_names = [spec.name for file in files for spec in file.results]
    trees = []
    for file_index, (file, file_instances) in enumerate(zip(files, instances, strict=True)):
        for instance in file_instances:
            has_clash = spec_names.count(instance.name) > 1
            name = f"{PurePath(file.filename).stem}.{instance.name}" if has_clash else instance.name
            spec = instance.spec
            trees.append(
                ReportedTree(
                    name, instance.object, file_index, spec.formula, spec.id, spec.title, spec.parameter
                )
            )
    return trees


def encode_specification(
    files: Sequence[Specification],
    trees: Sequence[ReportedTree],
    units: Mapping[str, str] | None = None,
    propositions: Sequence[Sequence[int]] | None = None,
    automata: Sequence[Automaton | None] = (),
    start_ns: int = 0,
) -> bytes:
    """Return the message with the specifications of a log. Equal arguments give equal bytes.

    Args:
        units: declared units, by name of the signal and by "" for lengths.
        propositions: nodes of the automaton's propositions, by tree.
        automata: automaton of each tree.
        start_ns: zero of times in texts.
    """
    # imported here, because an evaluation without messages needs no message types
    from spatial_replay.logs.schemas.Specification_pb2 import Specification as SpecificationMessage

    message = SpecificationMessage(start_ns=start_ns)
    for file in files:
        message.files.add(
            name="" if file.filename == "<text>" else file.filename,
            source=file.source,
            canonical=format_specification(file),
            profile=file.profile,
        )
    for tree_index, tree in enumerate(trees):
        result = message.results.add(name=tree.name, object=tree.object or "", file=tree.file)
        result.propositions.extend(propositions[tree_index] if propositions is not None else ())
        _add_nodes(result, tree, files[tree.file], units or {})
        tree_automaton = automata[tree_index] if automata else None
        if tree_automaton is not None:
            _add_automaton(result, tree, tree_automaton)
    return message.SerializeToString(deterministic=True)


def unit_of(formula: Formula, units: Mapping[str, str]) -> str:
    """Return the unit of a formula's robustness, which is the common unit of its atoms.

    Undeclared lengths have the unit "", numbers without a unit "1", and a signal with an unknown unit
    "units of NAME". Atoms of several units give "mixed".

    Args:
        units: declared units, by name of the signal and by "" for lengths.
    """
    declared_units = {_declared_unit(unit, units) for unit in units_of(formula)}
    if len(declared_units) > 1:
        return MIXED
    if not declared_units and any(iter_atoms(formula)):
        return DIMENSIONLESS  # all atoms compare modes: their robustness is infinite
    return declared_units.pop() if declared_units else units.get(FOOTPRINT_UNITS, FOOTPRINT_UNITS)


def unit_words(unit: str) -> str:
    """Return the words at an axis for a unit of `unit_of`."""
    words = {FOOTPRINT_UNITS: "footprint units", DIMENSIONLESS: "no unit", MIXED: "mixed units"}
    return words.get(unit, unit)


def _add_nodes(
    result: SpecificationResult, tree: ReportedTree, file: Specification, units: Mapping[str, str]
) -> None:
    relations, spec_text = RELATION_NAMES | file.relations, tree.written_texts(file.source)
    for identifier, parent, formula_node in iter_nodes(tree.formula):
        node = result.nodes.add(
            id=identifier,
            operator=operator_of(formula_node),
            name=formula_node.name or "",
            text=format_formula(formula_node, relations=relations),
            span_start=formula_node.span.start,
            span_end=formula_node.span.end,
            unit=unit_of(formula_node, units),
            written=spec_text[identifier],
        )
        if parent is not None:
            node.parent = parent


def _add_automaton(result: SpecificationResult, tree: ReportedTree, automaton: Automaton) -> None:
    from spatial_replay.automata.automaton import abbreviate, meanings
    from spatial_replay.automata.drawing import draw_automaton, guard_of

    drawing, short_names = draw_automaton(automaton), abbreviate(automaton)
    result.automaton.legend.extend(map(tree.with_object_name, meanings(short_names)))
    result.automaton.summary = drawing.summary
    result.automaton.left_out = drawing.left_out
    for state in drawing.states:
        result.automaton.states.add(
            number=state.number,
            about=state.about,
            column=state.column,
            row=state.row,
            accepting=state.is_accepting,
            can_reject=not state.is_won,
            distance=state.distance,
        )
    for move in drawing.moves:
        guard, label = tree.with_object_name(move.guard), tree.with_object_name(guard_of(short_names, move))
        result.automaton.moves.add(source=move.source, target=move.target, guard=guard, label=label)


def _declared_unit(unit: Unit, units: Mapping[str, str]) -> str:
    """Return the declared unit of an atom's number, or words instead."""
    if unit.divisor is not None or unit.kind == "orientation":
        return DIMENSIONLESS
    declared_unit = plain_unit(units.get(unit.signal or FOOTPRINT_UNITS, ""))
    if unit.kind == "rate":
        return per_second(declared_unit or f"units of {unit.signal or 'lengths'}")
    return declared_unit if unit.kind == "length" else declared_unit or f"units of {unit.signal}"


def logged_specifications(files: Sequence[Specification], units: Mapping[str, str]) -> list[Specification]:
    """Return the specifications in the form that a log stores, whose texts parse to equal specifications.

    Each file name gets a unique stem. Constants given from outside are written into the text. If the text
    still parses to another specification, for example with another profile, the canonical text replaces it.

    Args:
        units: units of the log, see `with_numbers`.

    Raises:
        SpecificationError: `with_numbers` fails.
    """
    logged: list[Specification] = []
    stems: set[str] = set()
    for file in files:
        path = PurePath(file.filename)
        first_stem, suffix = path.stem.strip("<>"), path.suffix or ".spatial"
        stem, copy_number = first_stem, 1
        while stem in stems:
            copy_number += 1
            stem = f"{first_stem}-{copy_number}"
        stems.add(stem)
        logged_copy = replace(_logged_copy(_Same(file)), filename=f"{stem}{suffix}")
        logged.append(with_numbers(logged_copy, units))
    return logged


def specification_attachments(files: Sequence[Specification], prefix: str) -> list[Attachment]:
    """Return the texts of `logged_specifications` as attachments whose names begin with `prefix`."""
    return [Attachment(f"{prefix}{file.filename}", "text/plain", file.source.encode()) for file in files]


@dataclass(frozen=True, slots=True, eq=False)
class _Same:
    """A cache key compared by identity, because equal specifications may have different texts."""

    file: Specification

    def __hash__(self) -> int:
        return id(self.file)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.file is self.file


# a batch evaluates many logs with the same specifications
@lru_cache(maxsize=64)
def _logged_copy(same: _Same) -> Specification:
    file = same.file
    for text_of in (attrgetter("source"), format_specification):
        try:
            text = text_of(file)
            if set(file.plugins) - set(used_modules(text)):
                # the text in a log must name every plug-in; this text lacks a plug-in of the command line
                continue
            read_back = parse_specification(text, filename=file.filename)
        except SpecificationError:
            continue
        if read_back == file:
            return file if text == file.source else read_back
    # relations defined in Python have no text
    return file
