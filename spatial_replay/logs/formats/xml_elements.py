"""Elements of an untrusted XML file, parsed in pieces.

Entities could fetch other files or expand without bound, so a file that declares a document type is refused,
and size, depth and number of elements are limited.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO
from xml.parsers import expat

from spatial_replay.errors import LogError
from spatial_replay.logs.formats.tracks import open_text
from spatial_replay.logs.read_options import FaultList

LARGEST_FILE = 512 * 2**20
"""Bytes, decompressed."""
MOST_ELEMENTS = 500_000
"""Elements inside one that is wanted."""
DEEPEST = 64
LONGEST_TEXT = 4096
_PIECE = 2**16


@dataclass(slots=True)
class Element:
    """An element with its content.

    Attributes:
        line: where it begins, counted from 1.
        text: its own text; texts beyond `LONGEST_TEXT` are cut.
    """

    name: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def child(self, name: str) -> Element | None:
        """Return the first child of a name."""
        return next(self.all(name), None)

    def all(self, name: str) -> Iterator[Element]:
        """Return every child of a name."""
        return (child for child in self.children if child.name == name)


def iter_elements(path: Path, faults: FaultList, wanted: frozenset[str]) -> Iterator[Element]:
    """Yield the root, without its content, then each of its children that has a wanted name.

    Of a broken file, the children before the damage are yielded, and the rest goes to `faults`.

    Raises:
        LogError: there is no root, the file declares a document type, or it exceeds the limits above.
    """
    collector = _Collector(path.name, wanted)
    with open_text(path) as stream:
        any_element = False
        for problem in _parse(stream, collector):
            for element in collector.take():
                any_element = True
                yield element
            if problem is not None:
                what = f"{path.name}:{collector.line}: {problem}"
                if not any_element:
                    raise LogError(f"{what}; give a well-formed XML file")
                faults.add(f"{what}; what follows is left out")


def _parse(stream: BinaryIO, collector: _Collector) -> Iterator[str | None]:
    """Parse one piece each step; the last step may yield what is wrong with the file."""
    read = 0
    while True:
        try:
            piece = stream.read(_PIECE)
            read += len(piece)
            if read > LARGEST_FILE:
                raise LogError(f"{collector.name} is larger than {LARGEST_FILE >> 20} MiB; split it")
            collector.parser.Parse(piece, not piece)
        except expat.ExpatError as error:
            yield f"the XML is broken ({expat.ErrorString(error.code)})"
            return
        except (EOFError, zlib.error, LookupError, ValueError) as error:
            # broken compression, or an unknown encoding
            yield f"the file cannot be read ({error})"
            return
        yield None
        if not piece:
            return


class _Collector:
    """Builds elements from the events of a parser."""

    def __init__(self, name: str, wanted: frozenset[str]) -> None:
        self.name = name
        self._wanted = wanted
        self._open: list[Element] = []
        self._depth = self._inside = 0
        self._done: list[Element] = []
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartDoctypeDeclHandler = self._doctype
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text

    @property
    def line(self) -> int:
        return self.parser.CurrentLineNumber

    def take(self) -> list[Element]:
        """Return the elements that were finished since the last call."""
        done, self._done = self._done, []
        return done

    def _doctype(self, *declared: object) -> None:
        raise LogError(
            f"{self.name}:{self.line}: the file declares a document type, whose entities are not trusted;"
            " remove <!DOCTYPE …>"
        )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > DEEPEST:
            place = f"{self.name}:{self.line}"
            raise LogError(f"{place}: elements are nested deeper than {DEEPEST}; flatten them")
        if self._depth == 1:
            self._done.append(Element(name, attributes, self.line))
        elif self._open or (self._depth == 2 and name in self._wanted):
            self._begin(Element(name, attributes, self.line))

    def _begin(self, element: Element) -> None:
        self._inside = self._inside + 1 if self._open else 0
        if self._inside > MOST_ELEMENTS:
            first = self._open[0]
            raise LogError(
                f"{self.name}:{first.line}: <{first.name}> has more than {MOST_ELEMENTS} elements; split it"
            )
        if self._open:
            self._open[-1].children.append(element)
        self._open.append(element)

    def _end(self, name: str) -> None:
        self._depth -= 1
        if self._open:
            element = self._open.pop()
            element.text = element.text.strip()
            if not self._open:
                self._done.append(element)

    def _text(self, text: str) -> None:
        if self._open and len(self._open[-1].text) < LONGEST_TEXT:
            self._open[-1].text += text[:LONGEST_TEXT]
