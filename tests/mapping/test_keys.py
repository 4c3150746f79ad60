"""Keys and paths of mapping files, for fields that their names alone do not explain."""

from __future__ import annotations

from typing import Any

import pytest
from google.protobuf.struct_pb2 import Struct

from mapping.feeding import SECOND, Feed, Made, make
from spatial_replay import UsageError


def read(keys: str, *contents: Any, mapping: str = "", name: str = "a/Thing") -> Made:
    """Read contents, one each second, of the topic /t with some keys."""
    feed = Feed(types={"/t": name})
    for second, content in enumerate(contents):
        feed.add("/t", second * SECOND, content)
    return make(f"{mapping}\ntopics:\n  /t: {{{keys}}}", feed)


def test_flat_keys_are_read_in_quotes() -> None:
    content = {"pose.x": 1.0, "pose.y": 2.0, "größe": 3.0, "tag": "cup"}
    keys = """name: "{'tag'}", position: ["'pose.x'", "'pose.y'"], shape: {disc: "'größe'"}"""
    assert read(keys, content).centre(0, "cup") == (1.0, 2.0)
    with pytest.raises(UsageError, match=r"a key with a dot stands in quotes: 'pose\.x'"):
        read("position: [pose.x, pose.y]", content)


def test_an_element_is_chosen_by_its_field() -> None:
    def nodes(**states: str) -> dict[str, Any]:
        return {"log": [{"node": node, "state": state} for node, state in states.items()]}

    contents = nodes(Spin="RUNNING", Follow="RUNNING"), nodes(Spin="FAILURE"), nodes(Follow="FAILURE")
    made = read("signals: {follow: 'log[node=Follow].state', last: 'log[-1].state'}", *contents)
    follow, last = (made.trace.signals[name].tolist() for name in ("follow", "last"))
    # the node that a message leaves out is unknown there
    assert [value == other for value, other in zip(follow, last, strict=True)] == [True, False, True]
    assert follow[1] != follow[1]
    assert made.faults == ()
    with pytest.raises(UsageError, match="has no field 'nod'; did you mean 'node'"):
        read("signals: {follow: 'log[nod=Follow].state'}", *contents)


def test_the_fields_of_a_protobuf_struct_are_read_by_name() -> None:
    message = Struct()
    message.update({"robots": {"r1": {"x": 1.0, "y": 2.0}, "r2": {"x": 3.0, "y": 4.0}}, "charge": 0.5})
    made = read("objects: 'robots[*]', name: '{index}', signals: {charge: charge, x: robots.r2.x}", message)
    assert [made.centre(0, name) for name in ("r1", "r2")] == [(1.0, 2.0), (3.0, 4.0)]
    assert [made.trace.signals[name][0] for name in ("charge", "x")] == [0.5, 3.0]
