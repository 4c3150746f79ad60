"""Definitions of message types: what is understood, and what is refused before any code is made of it."""

from __future__ import annotations

import random
from typing import Any

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from spatial_replay import LogError
from spatial_replay.bags.definitions import (
    check_definitions,
    definitions_from_msg,
    full_type_name,
    msg_from_definitions,
)
from spatial_replay.bags.ros_decoders import ros_decoder, ros_definitions, standard_schema
from spatial_replay.logs.messages import Schema

SEPARATOR = "=" * 80

TAGS = f"""\
# tags that a camera sees
std_msgs/Header header
Tag[] tags          # all of them
float64[9] matrix
string<=10 label "none"
int32 LIMIT=5       # a constant
uint8 kLower=1
{SEPARATOR}
MSG: own_msgs/Tag
int32 id
geometry_msgs/Point[<=4] corners
time seen
"""


def test_a_definition_is_read_with_the_types_it_uses() -> None:
    found = definitions_from_msg(TAGS, "own_msgs/Tags")
    assert list(found) == ["own_msgs/msg/Tags", "own_msgs/msg/Tag"]
    tags, tag = found.values()
    assert [(field.name, field.type, field.kind, field.size, field.longest) for field in tags] == [
        ("header", "std_msgs/msg/Header", "scalar", 0, 0),
        ("tags", "own_msgs/msg/Tag", "sequence", 0, 0),
        ("matrix", "float64", "array", 9, 0),
        ("label", "string", "scalar", 0, 10),
    ]
    assert [(field.type, field.size) for field in tag] == [
        ("int32", 0),
        ("geometry_msgs/msg/Point", 4),
        ("builtin_interfaces/msg/Time", 0),
    ]


@pytest.mark.parametrize(
    "note", ["@optional ", "@optional\n", "@key @optional ", '@unit("m") ', "@key # why\n"]
)
def test_an_annotation_leaves_its_field(note: str) -> None:
    plain = definitions_from_msg("float64 x\nuint8 quality\nuint8 mode", "a/B")
    assert definitions_from_msg(f"float64 x\n{note}uint8 quality\n@key uint8 mode", "a/B") == plain


@pytest.mark.parametrize("note", ["@key ", "@optional ", '@unit(value="m") '])
def test_an_annotation_in_idl_leaves_its_field(note: str) -> None:
    payload = b"\x00\x01\x00\x00" + bytes(8) + b"\x07\x00\x00\x00"
    text = f"module a {{ module msg {{ struct B {{ double x; {note}long id; }}; }}; }};"
    decoded: Any = ros_decoder("a/msg/B", "cdr", Schema("a/msg/B", "ros2idl", text.encode()))(payload)
    assert decoded.id == 7


def test_lines_may_end_as_on_windows() -> None:
    assert definitions_from_msg(TAGS.replace("\n", "\r\n"), "own_msgs/Tags") == definitions_from_msg(
        TAGS, "own_msgs/Tags"
    )


def test_a_definition_written_out_reads_as_itself() -> None:
    found = definitions_from_msg(TAGS, "own_msgs/Tags")
    assert definitions_from_msg(msg_from_definitions(found, "own_msgs/msg/Tags"), "own_msgs/Tags") == found


@pytest.mark.parametrize("store", [Stores.ROS1_NOETIC, Stores.ROS2_HUMBLE], ids=["ros1", "ros2"])
def test_standard_types_are_understood_as_by_rosbags(store: Stores) -> None:
    typestore = get_typestore(store)
    encoding: Any = "ros1" if store is Stores.ROS1_NOETIC else "cdr"
    for name in (
        "nav_msgs/msg/Odometry",
        "sensor_msgs/msg/PointCloud2",
        "visualization_msgs/msg/MarkerArray",
    ):
        text, _ = typestore.generate_msgdef(name, ros_version=1 if encoding == "ros1" else 2)
        schema = Schema(name, f"ros{1 if encoding == 'ros1' else 2}msg", text.encode())
        assert get_types_from_msg(text, name).keys() == definitions_from_msg(text, name).keys()
        (own,) = ros_definitions(name, encoding, schema)
        assert own in ros_definitions(name, encoding, None)


def test_a_standard_type_can_be_written_into_a_copy() -> None:
    schema = standard_schema("geometry_msgs/msg/PoseStamped", "cdr")
    assert (schema.name, schema.encoding) == ("geometry_msgs/msg/PoseStamped", "ros2msg")
    assert ros_definitions(schema.name, "cdr", schema) == ros_definitions(schema.name, "cdr", None)[:1]


@pytest.mark.parametrize(
    ("short", "full"),
    [
        ("geometry_msgs/Pose", "geometry_msgs/msg/Pose"),
        ("geometry_msgs/msg/Pose", "geometry_msgs/msg/Pose"),
        ("own_msgs/srv/Ask_Event", "own_msgs/srv/Ask_Event"),
    ],
)
def test_names_of_types_are_normalised(short: str, full: str) -> None:
    assert full_type_name(short) == full


HOSTILE = {
    "code as a name": ("float64 __import__('os').system('false')", "is not a field"),
    "code as a type": ("a/b);import\tos x", "is not a field"),
    "code as a nested type": (
        f"float64 x\n{SEPARATOR}\nMSG: a/B');evil('\nfloat64 y",
        "is not a name of a message",
    ),
    "a dunder": ("float64 __class__", "is not a field"),
    "two fields of a name": ("float64 x\nint8 x", "two fields 'x'"),
    "itself": ("Evil evil", "contains itself"),
    "itself, round a corner": (f"Other o\n{SEPARATOR}\nMSG: a/Other\na/Evil[] e", "contains itself"),
    "a type that is missing": ("a/Gone gone", "'a/msg/Gone' is missing; it is used by 'a/msg/Evil'"),
    "a huge array of texts": ("string[1000000000] x", "requires 1000000000 values"),
    "arrays of arrays": (
        f"A[1000] a\n{SEPARATOR}\nMSG: a/A\nB[1000] b\n{SEPARATOR}\nMSG: a/B\nint8 x",
        "requires 1000000 values",
    ),
    "a sequence of nothing": (
        f"A[] a\n{SEPARATOR}\nMSG: a/A\nint8 X=1",
        "a sequence of items that take no bytes",
    ),
    "nothing but noise": ("\x00\x01", "is not a field"),
    "not even text": (b"\xff\xfe", "is not UTF-8"),
    "too much text": ("# " + "x" * 2**21, "characters; at most 262144 are read"),
}


@pytest.mark.parametrize(("definition", "reported"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_definitions_are_refused(definition: str | bytes, reported: str) -> None:
    data = definition if isinstance(definition, bytes) else definition.encode()
    with pytest.raises(LogError, match=r".") as caught:
        ros_decoder("a/msg/Evil", "ros1", Schema("a/Evil", "ros1msg", data))
    assert reported in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("name", ["Pose", "a/b/c/d/e", "a/../b", "a/msg/B'", "a/msg/é", "a" * 300 + "/B"])
def test_hostile_names_of_types_are_refused(name: str) -> None:
    with pytest.raises(LogError, match="is not a name of a message type"):
        ros_decoder(name, "cdr", Schema(name, "ros2msg", b"float64 x"))


def test_a_message_without_a_type_is_refused_with_the_remedy() -> None:
    with pytest.raises(LogError, match="no type of it; name a standard `type` in a mapping"):
        ros_decoder("", "cdr", Schema("", "ros2msg", b"float64 x"))


@pytest.mark.parametrize("word", ["class", "None", "self", "cls", "pos", "numpy"])
def test_fields_may_have_names_of_python_keywords(word: str) -> None:
    schema = Schema("a/msg/B", "ros2msg", f"float64 {word}\nfloat64 x".encode())
    decode = ros_decoder("a/msg/B", "cdr", schema)
    decoded: Any = decode(b"\x00\x01\x00\x00" + bytes(8) + b"\x00\x00\x00\x00\x00\x00\xf0\x3f")
    assert decoded.x == 1.0


def test_a_definition_in_another_language_is_refused() -> None:
    with pytest.raises(LogError, match="in 'omgidl'; ros1msg, ros2msg and ros2idl are read"):
        ros_decoder("a/msg/B", "cdr", Schema("a/msg/B", "omgidl", b"struct B {}"))


IDL = f"""\
{SEPARATOR}
IDL: a/msg/B
module a {{ module msg {{ struct B {{ double x; long id; a::msg::C c; }}; }}; }};
{SEPARATOR}
IDL: a/msg/C
module a {{ module msg {{ struct C {{ double y; }}; }}; }};
"""


def test_idl_is_read() -> None:
    decode = ros_decoder("a/msg/B", "cdr", Schema("a/msg/B", "ros2idl", IDL.encode()))
    payload = (
        b"\x00\x01\x00\x00" + b"\x00" * 6 + b"\xf0\x3f" + b"\x07" + b"\x00" * 7 + b"\x00" * 6 + b"\x00\x40"
    )
    decoded: Any = decode(payload)
    assert (decoded.x, decoded.id, decoded.c.y) == (1.0, 7, 2.0)


def test_idl_that_computes_too_much_is_refused() -> None:
    text = IDL.replace("double x", "double x[1 << 1000000000]")
    with pytest.raises(LogError, match="shifts numbers"):
        ros_decoder("a/msg/B", "cdr", Schema("a/msg/B", "ros2idl", text.encode()))


@pytest.mark.parametrize(("text", "language"), [(TAGS, "ros1msg"), (IDL, "ros2idl")], ids=["msg", "idl"])
def test_a_changed_definition_is_read_or_refused(text: str, language: str) -> None:
    randomly = random.Random(3)
    name, encoding = ("own_msgs/msg/Tags", "ros1") if language == "ros1msg" else ("a/msg/B", "cdr")
    for _ in range(300):
        changed = bytearray(text.encode())
        for _ in range(randomly.randrange(1, 4)):
            changed[randomly.randrange(len(changed))] = randomly.randrange(256)
        try:
            decode = ros_decoder(name, encoding, Schema(name, language, bytes(changed)))  # type: ignore[arg-type]
            decode(bytes(64))
        except LogError as error:
            assert str(error)


def test_types_that_cannot_be_used_are_refused_when_they_are_checked() -> None:
    assert list(
        check_definitions(definitions_from_msg("a/B b", "a/C") | {"a/msg/B": ()}, "a/msg/C", empty_bytes=1)
    )
