"""What a message of /spatial/specification says."""

from __future__ import annotations

import pytest

from spatial_replay import Specification
from spatial_replay.annotate.specification import ReportedTree, encode_specification, unit_of
from spatial_replay.logs.schemas.Specification_pb2 import Specification as SpecificationMessage
from spatial_replay.spec import format_specification
from spatial_replay.spec.diagnostics import Span
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Group,
    Misalignment,
    NamedSpec,
    Number,
    Quantified,
    Signal,
    SignedDistance,
    Temporal,
    TrackedName,
    Truth,
    Variable,
    iter_nodes,
)

CUP, PLATE = TrackedName("cup"), TrackedName("plate")
NEAR = Atom(
    "cup closeto[0.2] plate",
    "closeto",
    0.2 - SignedDistance(CUP, PLATE),
    terms=(CUP, PLATE),
    span=Span(16, 38),
)
FULL = Atom("battery >= 0.5", "signal", Signal("battery") - 0.5, parameters=("battery", ">=", 0.5))
TURNED = Atom("cup oriented[0.1] plate", "oriented", 0.1 - Misalignment(CUP, PLATE), terms=(CUP, PLATE))


def test_every_node_is_there_with_its_text_and_place():
    formula = Boolean("and", (Temporal("F", (NEAR,), name="reach"), Boolean("not", (FULL,))), name="done")
    file = Specification((NamedSpec("done", formula),), "paper", source="the text", filename="table.spatial")
    payload = encode_specification([file, file], [ReportedTree("done", "cup", 1, formula)], {"battery": "V"})
    message = SpecificationMessage.FromString(payload)
    assert [part.name for part in message.files] == ["table.spatial"] * 2
    assert message.files[0].source == "the text"
    assert message.files[0].canonical == format_specification(file)
    assert message.files[0].profile == "paper"
    [tree] = message.results
    assert (tree.name, tree.object, tree.file) == ("done", "cup", 1)
    parents = [node.parent if node.HasField("parent") else None for node in tree.nodes]
    assert parents == [parent for _, parent, _ in iter_nodes(formula)]
    assert [node.id for node in tree.nodes] == [0, 1, 2, 3, 4]
    assert [node.operator for node in tree.nodes] == ["and", "F", "closeto", "not", "signal"]
    assert [node.name for node in tree.nodes] == ["done", "reach", "", "", ""]
    assert tree.nodes[2].text == "cup closeto[0.2] plate"
    assert (tree.nodes[2].span_start, tree.nodes[2].span_end) == (16, 38)
    assert [node.unit for node in tree.nodes] == ["mixed", "", "", "V", "V"]


@pytest.mark.parametrize(
    ("formula", "unit"),
    [
        (NEAR, ""),
        (Truth(True), ""),
        (FULL, "units of battery"),
        (TURNED, "1"),
        (Boolean("or", (NEAR, TURNED)), "mixed"),
        (Temporal("U", (NEAR, Temporal("G", (NEAR,)))), ""),
        (Quantified("forall", ("a",), Group("all", class_name="*"), TURNED), "1"),
        (Atom("odd", "odd", Signal("load") + SignedDistance(CUP, Variable("a"))), "units of load"),
        (Atom("none", "none", Number(1.0)), "1"),
    ],
)
def test_a_node_has_the_unit_that_its_atoms_share(formula, unit):
    assert unit_of(formula, {}) == unit


def test_a_constant_takes_the_unit_it_is_compared_in():
    assert unit_of(FULL, {"battery": "V"}) == "V"
