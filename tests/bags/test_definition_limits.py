"""Definitions that ask for too much: refused at once, before anything is made of them."""

from __future__ import annotations

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from spatial_replay import LogError
from spatial_replay.bags.decoders import Topic, decoder_of
from spatial_replay.logs.messages import Schema

LINE = "=" * 80


def idl(body: str, constant: str = "1") -> str:
    return f"module p {{ module msg {{ const long A = {constant}; struct T {{ {body} double x; }}; }}; }};"


@pytest.mark.parametrize(
    "text",
    [
        "string[99000] q\n",
        "".join(f"float64 f{number}\n" for number in range(5000)),
        f"Q[1400] q\n{LINE}\nMSG: p/Q\nfloat64 a\nfloat64 b\nfloat64 c\n",
        "float64 x\n" + "#" * 300_000,
        "T0 a\n"
        + "".join(f"{LINE}\nMSG: p/T{number}\nT{number + 1} a\n" for number in range(20))
        + f"{LINE}\nMSG: p/T20\n"
        + "".join(f"string f{number}\n" for number in range(2000)),
    ],
)
def test_a_definition_that_makes_too_much_code_is_refused(text: str) -> None:
    with pytest.raises(LogError, match="are read"):
        decoder_of(Topic("/a", "p/msg/T", "ros1", schema=Schema("p/T", "ros1msg", text.encode())))


@pytest.mark.parametrize(
    "text",
    [
        idl("@verbatim (language='c', text=\"a\") " * 600),
        idl("", "((1))"),
        idl("", "(1)+(1)"),
        idl("sequence<" * 16 + "double" + ">" * 16 + " s;"),
        idl("") + "// " + "x" * 2**17,
    ],
)
def test_an_idl_definition_that_takes_long_to_parse_is_refused(text: str) -> None:
    with pytest.raises(LogError, match=r"are (not )?read"):
        decoder_of(Topic("/a", "p/msg/T", "cdr", schema=Schema("p/msg/T", "ros2idl", text.encode())))


def test_comments_and_strings_in_idl_may_hold_parentheses() -> None:
    text = idl('// ((\n @verbatim (language="comment", text="in m ((up))") sequence<string<9>, 4> s; // ((\n')
    topic = Topic("/a", "p/msg/T", "cdr", schema=Schema("p/msg/T", "ros2idl", text.encode()))
    assert decoder_of(topic) is not None


def chain(count: int, *, closed: bool = False) -> Topic:
    described = FileDescriptorSet()
    for number in range(count):
        file = described.file.add(name=str(number), syntax="proto3")
        if number + 1 < count or closed:
            file.dependency.append(str((number + 1) % count))
    described.file[0].message_type.add(name="T")
    return Topic("/a", "T", "protobuf", schema=Schema("T", "protobuf", described.SerializeToString()))


def test_files_of_protobuf_come_in_any_order_but_not_in_any_number() -> None:
    assert decoder_of(chain(300)) is not None
    with pytest.raises(LogError, match="imports itself"):
        decoder_of(chain(3, closed=True))
    with pytest.raises(LogError, match="5000 files"):
        decoder_of(chain(5000))
