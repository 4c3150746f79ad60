"""Panels of a report: the facts of a replay as JSON, with arrays in a compact form.

All arrays of a page are packed (see `packed_bytes`), joined, compressed and written in Base64.
"""

from __future__ import annotations

import base64
import json
import math
import re
import zlib
from array import array
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from operator import itemgetter
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from spatial_replay.annotate.requirements import requirements_of
from spatial_replay.annotate.scene.scene_frames import (
    SHADES,
    DrawnEntity,
    DrawnViolation,
    SceneFrame,
    SceneFrames,
)
from spatial_replay.annotate.scene.scene_template import REGION
from spatial_replay.annotate.specification import unit_of
from spatial_replay.automata.automaton import Automaton, abbreviate, meanings
from spatial_replay.automata.drawing import draw_automaton
from spatial_replay.bags.open import is_log, open_messages
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.remote import LogFile
from spatial_replay.logs.schemas.PlanDecision_pb2 import (
    PlanCandidate,
    PlanDecision,
    PlanEdge,
    PlanTarget,
)
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import CAMERA_VIDEO, is_image_type
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.sentences import divisor_of
from spatial_replay.monitor.verdict import final_verdict
from spatial_replay.perception.image_sources import ImageTopic
from spatial_replay.perception.opencv import Image, encode_jpeg
from spatial_replay.planning.decision_log import (
    MOST_LISTED,
    aim_of,
    best_robustness,
    decision_from_payload,
    demand_words,
    joint_suffix,
    kind_text,
    latest_decisions,
    limiting_conjuncts,
    map_fields,
    plain,
    room_sentence,
)
from spatial_replay.planning.decisions import Reason
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Boolean, Formula, Temporal, iter_nodes, operands_of, operator_of
from spatial_replay.text import cut, json_fields, with_unit

Kind: TypeAlias = Literal["f8", "f4", "i4", "u2", "u1"]
"""Number types of arrays in the page: float64, float32, int32, uint16, uint8."""
Reference: TypeAlias = Mapping[str, Any]
"""Position of an array in the page: kind of numbers, offset of the first byte, and count of numbers."""

_LEVEL: Final = 6


class Packing:
    """Collects the arrays of one page."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._size = 0

    def add(self, array: NDArray[Any], kind: Kind) -> Reference:
        """Add an array, flattened by rows, and return its position."""
        data = packed_bytes(array, kind)
        reference = {"kind": kind, "offset": self._size, "length": int(np.size(array))}
        self._pieces.append(data)
        self._size += len(data)
        return reference

    def text(self) -> str:
        """Return all arrays as one text without characters that HTML interprets."""
        return base64.b64encode(zlib.compress(b"".join(self._pieces), _LEVEL)).decode("ascii")


def packed_bytes(array: NDArray[Any], kind: Kind) -> bytes:
    """Return the numbers of an array, by rows, as bytes that compress well; read.js unpacks them.

    The bits of a number are read as an unsigned integer. Differences of consecutive integers are written
    plane by plane: first the lowest bytes of all differences, then the next bytes, and so on. The result
    compresses to 42 % of the size of plain numbers.
    """
    numbers = np.ascontiguousarray(array, f"<{kind}").ravel()
    codes = numbers.view(f"<u{numbers.itemsize}")
    differences = np.diff(codes, prepend=np.zeros(1, codes.dtype))
    return differences.view(np.uint8).reshape(-1, numbers.itemsize).T.tobytes()


def unpack_array(reference: Reference, data: bytes) -> NDArray[Any]:
    """Return one array of a page, flat, from the bytes of all arrays."""
    dtype, length = np.dtype(f"<{reference['kind']}"), reference["length"]
    planes = np.frombuffer(data, np.uint8, length * dtype.itemsize, reference["offset"])
    differences = np.ascontiguousarray(planes.reshape(dtype.itemsize, length).T)
    codes = np.cumsum(differences.view(f"<u{dtype.itemsize}").ravel(), dtype=f"<u{dtype.itemsize}")
    return codes.view(dtype)


def singles(numbers: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return numbers in single precision. Negative numbers stay negative, because the sign is the verdict."""
    with np.errstate(over="ignore", under="ignore"):
        rounded = numbers.astype(np.float32)
    smallest = np.finfo(np.float32).smallest_subnormal
    return np.where((numbers < 0.0) & (rounded == 0.0), -smallest, rounded)


def json_text(value: Any) -> str:
    """Return JSON that is safe within a script element, with any texts.

    Escapes keep texts such as `</script>` from ending the element:
    https://html.spec.whatwg.org/multipage/scripting.html#restrictions-for-contents-of-script-elements
    """
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


_CODE: Final = re.compile(
    r"""
    (?<![^\s(]) `                           # what quotes a formula follows a space or a parenthesis
    ( (?: "(?:[^"\\]|\\.)*" | [^`"] )*    # a name in its own quotes may have such signs in it
      (?: "[^"]*… )? )                       # and may be cut short
    ` (?= [\s,.:;)] | $ )
    """,
    re.VERBOSE,
)


def sentence_parts(sentence: str) -> list[str]:
    """Split a sentence into alternating text and code, beginning with text.

    Code is between backquotes; names of objects in code may contain backquotes, too. Numbers in the text have
    the form of `with_signs`.
    """
    parts = _CODE.split(sentence)
    parts[::2] = map(with_signs, parts[::2])
    return parts


_MINUS: Final = re.compile(r"(?<![\w.\]-])-(?=\.?\d|inf\b)")
_INFINITE: Final = re.compile(r"(?<![\w.-])[+]?inf(?![\w-])")


def with_signs(words: str) -> str:
    """Return a text with typographic numbers, such as "−0.05" and "−∞"; names such as run-1 stay."""
    return _INFINITE.sub("∞", _MINUS.sub("\N{MINUS SIGN}", words))


MOST_NODES: Final = 400
"""Limit of shown nodes of a tree."""
_LONGEST: Final = 400
"""Limit of a node's text, characters."""
_PLACE: Final = "…"


def shown_nodes(formula: Formula) -> tuple[int, ...]:
    """Return the ids of the nodes on the page, in order; a large tree keeps only its uppermost nodes."""
    nodes = list(iter_nodes(formula))
    if len(nodes) <= MOST_NODES:
        return tuple(range(len(nodes)))
    depths: list[int] = []
    for _, parent, _ in nodes:
        depths.append(0 if parent is None else depths[parent] + 1)
    uppermost = sorted(range(len(nodes)), key=lambda identifier: (depths[identifier], identifier))
    return tuple(sorted(uppermost[:MOST_NODES]))


def initial_nodes(formula: Formula) -> frozenset[int]:
    """Return the ids of nodes without a temporal operator above.

    Only the values of these nodes at the first sample affect the result.
    """
    initial: set[int] = set()
    formulas: list[Formula] = []
    for identifier, parent, node in iter_nodes(formula):
        formulas.append(node)
        if parent is None or (parent in initial and not isinstance(formulas[parent], Temporal)):
            initial.add(identifier)
    return frozenset(initial)


def tree_value(
    result: SpecResult, relations: frozenset[str], units: Mapping[str, str], calls: Mapping[int, str]
) -> list[Mapping[str, Any]]:
    """Return the shown nodes, each with its text and its final verdict.

    Args:
        relations: names of the relations that the file may use.
        units: declared units.
        calls: texts of nodes that call a `def`, as the file writes them, by id.
    """
    # a template's parameter is replaced by the object of the instance
    formula = result.evidence.bound(result.formula)
    nodes, initial_ids = shown_nodes(formula), initial_nodes(formula)
    index_by_id = {identifier: index for index, identifier in enumerate(nodes)}
    return [
        {
            "id": identifier,
            "parent": None if parent is None else index_by_id[parent],
            "name": node.name or "",
            "head": cut(calls.get(identifier) or _head(node, relations), _LONGEST),
            "text": cut(format_formula(node, relations=relations), _LONGEST),
            "unit": unit_of(node, units),
            "divisor": divisor_of(node),
            "initial": identifier in initial_ids,
            "verdict": str(final_verdict(*result.final[identifier].tolist())),
            "value": final_text(float(result.values[identifier]), *result.final[identifier].tolist()),
        }
        for identifier, parent, node in iter_nodes(formula)
        if identifier in index_by_id
    ]


def requirement_values(result: SpecResult, samples: Integers, packing: Packing) -> list[Mapping[str, Any]]:
    """Return the requirements of a formula (see `annotate.requirements`) whose nodes are shown.

    Args:
        samples: (S,) indices of the samples on the page.
    """
    index_by_id = {identifier: index for index, identifier in enumerate(shown_nodes(result.formula))}
    has_final_verdicts = result.semantics == "ltlf"
    return [
        {
            "node": index_by_id[requirement.node],
            "is_condition": requirement.is_condition,
            "is_invariant": requirement.is_invariant,
            "obligation": requirement.obligation
            and {"node": index_by_id[requirement.obligation.node], "sign": requirement.obligation.sign},
            "standing": packing.add(requirement.standing(result.series, samples), "u1"),
        }
        for requirement in requirements_of(result.formula, result.object, settles=has_final_verdicts)
        if requirement.node in index_by_id
    ]


def final_text(robustness: float, lower: float, upper: float, unit: str = "") -> str:
    """Return a node's final robustness with its unit, or the ends of its interval."""
    if math.isnan(robustness) or not (lower == upper == robustness):
        if math.isnan(lower):
            return "" if math.isnan(robustness) else with_unit(robustness, unit)
        return f"{with_unit(lower, unit)} … {with_unit(upper, unit)}"
    return with_unit(robustness, unit)


def named_nodes(formula: Formula) -> tuple[int, ...]:
    """Return the ids of the nodes with curves: the root, and all named nodes that are shown."""
    nodes = set(shown_nodes(formula))
    return tuple(
        identifier
        for identifier, parent, node in iter_nodes(formula)
        if identifier in nodes and (parent is None or node.name)
    )


def _head(node: Formula, relations: frozenset[str]) -> str:
    """Return a node's text with an ellipsis for each operand."""
    if isinstance(node, Boolean):
        return operator_of(node)
    text = format_formula(node, relations=relations)
    for operand in (format_formula(operand_node, relations=relations) for operand_node in operands_of(node)):
        for operand_text in (f"({operand})", operand):
            if operand_text in text:
                text = text.replace(operand_text, _PLACE, 1)
                break
    return text


class StatePath:
    """The states of a run in its automaton, collected message by message.

    Attributes:
        times_ns: times of the messages.
        codes: code of the states in each message, see `sets`.
        sets: code of each set of states that the run may be in.
    """

    def __init__(self) -> None:
        self.times_ns, self.codes = array("q"), array("q")
        self.sets: dict[tuple[int, ...], int] = {}

    def add(self, time_ns: int, states: tuple[int, ...]) -> None:
        """Add the states after a sample."""
        self.times_ns.append(time_ns)
        self.codes.append(self.sets.setdefault(states, len(self.sets)))


def automaton_value(automaton: Automaton, path: StatePath, named: Callable[[str], str]) -> Mapping[str, Any]:
    """Return the drawing of an automaton: states with their positions, transitions with their guards.

    Args:
        named: function that replaces a template's parameter in a text by the object.
    """
    visited = {state for states in path.sets for state in states}
    drawing, short_automaton = draw_automaton(automaton, visited), abbreviate(automaton)
    return {
        **json_fields(drawing, "summary", "left_out"),
        "states": [
            {
                **json_fields(state, "number", "about", "is_accepting", "is_lost", "is_won"),
                "at": (state.column, state.row),
            }
            for state in drawing.states
        ],
        # arrows and legend have the same words as in a drawing by Graphviz
        "moves": [
            {**move._asdict(), "guard": named(move.guard), "label": named(short_move.guard)}
            for move, short_move in zip(
                drawing.moves, draw_automaton(short_automaton, visited).moves, strict=True
            )
        ],
        "legend": list(map(named, meanings(short_automaton))),
    }


MOST_EVENTS: Final = 2_000
"""Limit of events in a page; later events are left out."""


def event_values(events: Sequence[Event], first_ns: int) -> list[Mapping[str, Any]]:
    """Return the first events as the page's script reads them, by start time."""
    ordered = sorted(events, key=start_of)
    return [_event_value(event, first_ns) for event in ordered[:MOST_EVENTS]]


def start_of(event: Event) -> int:
    """Return the start time of an event in nanoseconds."""
    time_ns: int = event.start_time.ToNanoseconds()
    return time_ns


def _event_value(event: Event, first_ns: int) -> Mapping[str, Any]:
    facts = {entry.key: entry.value for entry in event.metadata}
    return {
        "time": (start_of(event) - first_ns) / 1e9,
        "status": _status(facts),
        "specification": facts.get("specification", ""),
        "object": facts.get("object"),
        "parts": sentence_parts(facts.get("message", "")),
    }


def _status(facts: Mapping[str, str]) -> str:
    if "vacuous" in facts:
        return "vacuous"
    if facts.get("verdict") != "pending":
        return facts.get("verdict", "")
    return "holding" if facts.get("sign") == "positive" else "pending"


MOST_PICTURES: Final = 60
"""Limit of pictures in a page: pictures of deciding samples, and pictures at equal intervals."""
MOST_PICTURE_BYTES: Final = 1_500_000
"""Limit of all pictures of a page in Base64, characters."""

_FORMS: Final = ((320, 70), (320, 45), (200, 45), (120, 40), (60, 30))
"""Widths in pixels and JPEG qualities, tried in this order until a picture is small enough."""


NO_PICTURES: Final[Mapping[str, Any]] = MappingProxyType(
    {"topic": "", "reason": "", "times": (), "pictures": ()}
)
"""The pictures of a log without images."""


def pictures_of(
    source: Source, first_ns: int, span_ns: tuple[int, int], decided_ns: Collection[int]
) -> Mapping[str, Any]:
    """Return small pictures of a log's camera as the page's script reads them, or the reason for none.

    Args:
        span_ns: first and last time.
        decided_ns: times of deciding samples; their pictures take up to half of the limit.
    """
    path = source.path
    topic = _image_topic(path) if isinstance(path, LogFile) else None
    if topic is None or not isinstance(path, LogFile):
        return NO_PICTURES
    decided_times_ns = sorted(decided_ns)[: MOST_PICTURES // 2]
    spaced_times_ns = np.linspace(*span_ns, MOST_PICTURES - len(decided_times_ns)).astype(np.int64).tolist()
    try:
        frames = ImageTopic(path, topic).frames_at(sorted({*decided_times_ns, *spaced_times_ns}))
        pictures = [(frame.time_ns, _small(frame.image)) for frame in frames]
    except (LogError, UsageError) as error:
        return {**NO_PICTURES, "topic": topic, "reason": f"The pictures of {topic} are not shown: {error}."}
    return {
        "topic": topic,
        "reason": "" if pictures else f"No picture of {topic} can be decoded.",
        "times": [(time_ns - first_ns) / 1e9 for time_ns, _ in pictures],
        "pictures": [
            f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}" for _, jpeg in pictures
        ],
    }


def _image_topic(path: LogFile) -> str | None:
    """Return the image topic that layouts also show: `CAMERA_VIDEO`, or else the first image topic."""
    if not is_log(path):
        return None
    try:
        topics = [
            image_topic.name
            for image_topic in open_messages(path).topics()
            if is_image_type(image_topic.type)
        ]
    except LogError:
        # the replay has already reported the damage
        return None
    return CAMERA_VIDEO if CAMERA_VIDEO in topics else next(iter(topics), None)


def _small(image: Image) -> bytes:
    # Base64 writes 3 bytes as 4 characters; 64 bytes are room for the head of the URL
    byte_limit = MOST_PICTURE_BYTES * 3 // 4 // MOST_PICTURES - 64
    jpeg = b""
    for width, quality in _FORMS:
        jpeg = encode_jpeg(image, width, quality)
        if len(jpeg) <= byte_limit:
            break
    return jpeg


MOST_FRAMES: Final = 3_000
"""Limit of frames in a page."""
MOST_CORNERS: Final = 2_000_000
"""Limit of outline corners in all frames together."""
MOST_ARROWS: Final = 30_000
"""Limit of arrows in all frames together. The worst results have arrows, up to this limit."""
_ABSENT: Final = 65_535
_STEPS: Final = 65_535
"""Steps of a coordinate along each side of the scene: 16 bits, finer than any screen."""


class ReportedScene:
    """Frames of a scene, collected one by one. Beyond a limit, every other frame is dropped.

    Attributes:
        frames: frames with their times.
        stride: number of scene messages per frame.
    """

    def __init__(self) -> None:
        self.frames: list[tuple[int, SceneFrame]] = []
        self.stride = 1
        self._count = self._corners = 0
        self._last_ns: int | None = None

    def add(self, frames: SceneFrames) -> None:
        """Add the next frames."""
        # `add_frame` drops all other frames, so they are not computed
        frame_numbers = np.arange(-self._count % self.stride, len(frames.times_ns), self.stride)
        has_repeated_time = len(frames.times_ns) > 0 and int(frames.times_ns[0]) == self._last_ns
        frames = replace(
            frames, chosen=np.union1d(frame_numbers, [0]) if has_repeated_time else frame_numbers
        )
        for index, time_ns in enumerate(frames.times_ns.tolist()):
            self.add_frame(time_ns, partial(frames.frame, index))

    def add_frame(self, time_ns: int, frame_of: Callable[[], SceneFrame]) -> None:
        """Add the next frame. `frame_of` computes the frame, and is called only for frames that are kept.

        The last frame, of the finished log, has the time of the previous frame, and replaces the previous
        frame.
        """
        if time_ns == self._last_ns:
            while self.frames and self.frames[-1][0] == time_ns:
                self.frames.pop()
            self.frames.append((time_ns, frame_of()))
            return
        self._last_ns = time_ns
        if self._count % self.stride == 0:
            frame = frame_of()
            self.frames.append((time_ns, frame))
            self._corners += frame.corners
        self._count += 1
        while len(self.frames) > MOST_FRAMES or (self._corners > MOST_CORNERS and len(self.frames) > 2):
            self.frames = self.frames[::2]
            self.stride *= 2
            self._corners = sum(frame.corners for _, frame in self.frames)

    def insert(self, frames: SceneFrames) -> None:
        """Insert frames at times that were not collected."""
        for index, time_ns in enumerate(frames.times_ns.tolist()):
            position = bisect_left(self.frames, time_ns, key=itemgetter(0))
            self.frames.insert(position, (time_ns, frames.frame(index)))

    @property
    def times_ns(self) -> Integers:
        """(F,) int64, the times of the frames."""
        return np.array([time_ns for time_ns, _ in self.frames], np.int64)


class _Box(NamedTuple):
    """The bounding box of a drawing: lower left corner and positive size."""

    low: Floats
    size: Floats

    def steps(self, points: Floats) -> Floats:
        """Return points (n, 2) as steps, 0 to `_STEPS` within the box."""
        return np.asarray(np.round((points - self.low) / self.size * _STEPS))


def scene_value(
    scene: ReportedScene,
    kept_ns: Integers,
    first_ns: int,
    places: Mapping[tuple[int, int], tuple[int, int]],
    packing: Packing,
) -> Mapping[str, Any]:
    """Return the scene as the page's script reads it, with coordinates as steps of the bounding box.

    Args:
        kept_ns: times of the samples on the page.
        places: indices on the page by (result, node).
    """
    times_ns = scene.times_ns
    is_kept = np.isin(times_ns, kept_ns)
    frames = [
        frame
        for (_, frame), is_kept_frame in zip(scene.frames, is_kept.tolist(), strict=True)
        if is_kept_frame
    ]
    entities = _entities(frames)
    # a frame has at most one arrow per result
    page_index_by_result = dict(
        sorted((result, page_index) for (result, _), (page_index, _) in places.items())
    )
    result_numbers = sorted(page_index_by_result, key=page_index_by_result.__getitem__)
    result_limit = max(1, MOST_ARROWS // max(len(frames), 1))
    numbered_arrows = [
        (frame_index, arrow)
        for frame_index, frame in enumerate(frames)
        for result, page_index in page_index_by_result.items()
        if page_index < result_limit and (arrow := frame.violation(result)) is not None
    ]
    arrows = [arrow for _, arrow in numbered_arrows]
    outlines = list(dict.fromkeys(arrow.dashes for arrow in arrows))
    name_groups = list(dict.fromkeys(arrow.names for arrow in arrows))
    box = _box(entities, arrows)
    return {
        "times": packing.add((times_ns[is_kept] - first_ns) / 1e9, "f8"),
        "stride": scene.stride,
        "shades": packing.add(SHADES, "u1"),
        "low": box.low.tolist(),
        "high": (box.low + box.size).tolist(),
        "entities": [
            _entity_value(identifier, entity_by_frame, len(frames), result_numbers, box, packing)
            for identifier, entity_by_frame in sorted(entities.items(), key=_drawing_order)
        ],
        "violations": {
            "frames": packing.add(np.array([frame_index for frame_index, _ in numbered_arrows]), "i4"),
            "points": packing.add(box.steps(_join_points([arrow.ends for arrow in arrows])), "u2"),
            "labels": [arrow.label for arrow in arrows],
            "atoms": [arrow.atom for arrow in arrows],
            "robustness": packing.add(np.array([arrow.robustness for arrow in arrows]), "f8"),
            "holds": packing.add(np.array([arrow.holds for arrow in arrows]), "u1"),
            "outlines": outlines,
            "outline": packing.add(np.array([outlines.index(arrow.dashes) for arrow in arrows]), "i4"),
            "names": name_groups,
            "name": packing.add(np.array([name_groups.index(arrow.names) for arrow in arrows]), "i4"),
            # times of earlier samples, for arrows at earlier samples
            "moments": [
                None if arrow.moment_ns is None else (arrow.moment_ns - first_ns) / 1e9 for arrow in arrows
            ],
            # indices of result and node on the page, -1 for a node that the page leaves out
            "places": packing.add(
                np.array(
                    [
                        places.get((arrow.result, arrow.node), (page_index_by_result[arrow.result], -1))
                        for arrow in arrows
                    ]
                ),
                "i4",
            ),
        },
    }


def _drawing_order(item: tuple[str, Any]) -> tuple[bool, str]:
    """Sort regions before objects, so that objects are drawn over regions."""
    return not item[0].startswith(REGION), item[0]


def _entities(frames: Sequence[SceneFrame]) -> Mapping[str, dict[int, DrawnEntity]]:
    """Return the drawn entities by id and by number of the frame."""
    frames_by_entity: dict[str, dict[int, DrawnEntity]] = {}
    for frame_index, frame in enumerate(frames):
        for identifier, entity in frame.entities.items():
            frames_by_entity.setdefault(identifier, {})[frame_index] = entity
    return frames_by_entity


def _box(entities: Mapping[str, Mapping[int, DrawnEntity]], arrows: Sequence[DrawnViolation]) -> _Box:
    rings = [
        ring
        for entity_by_frame in entities.values()
        for entity in entity_by_frame.values()
        for ring in entity.rings
    ]
    points = _join_points([*rings, *(arrow.ends for arrow in arrows)])
    if not len(points):
        return _Box(np.zeros(2), np.ones(2))
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    return _Box(low, np.where(size > 0.0, size, 1.0))


def _join_points(points: Sequence[Floats]) -> Floats:
    """Return all points as (n, 2), also for an empty sequence."""
    return np.concatenate([np.empty((0, 2)), *points])


def _entity_value(
    identifier: str,
    entities: Mapping[int, DrawnEntity],
    frame_count: int,
    results: Sequence[int],
    box: _Box,
    packing: Packing,
) -> Mapping[str, Any]:
    """Return an entity with its form in each frame, and its points and colours in frames with the entity.

    Args:
        results: indices of the page's results, in the order of the shades.
    """
    form_numbers: dict[tuple[tuple[int, ...], bool], int] = {}
    form_of_frame = np.full(frame_count, _ABSENT, np.int64)
    for frame, entity in entities.items():
        form = tuple(len(ring) for ring in entity.rings), entity.is_last
        form_of_frame[frame] = form_numbers.setdefault(form, len(form_numbers))
    entity_kind, _, name = identifier.partition("/")
    rings = [ring for entity in entities.values() for ring in entity.rings]
    has_shades = all(entity.shades for entity in entities.values())
    frame_shades = [
        np.frombuffer(entity.shades, np.uint8)[list(results)] for entity in entities.values() if has_shades
    ]
    return {
        "kind": entity_kind,
        "name": name,
        "forms": [rings for rings, _ in form_numbers],
        # forms of the last outline of a missing object
        "last": [form_number for (_, is_last), form_number in form_numbers.items() if is_last],
        "form": packing.add(form_of_frame, "u2"),
        "points": packing.add(box.steps(_join_points(rings)), "u2"),
        "colours": packing.add(np.array([entity.colour for entity in entities.values()]), "u1"),
        "shades": packing.add(np.array(frame_shades), "u1") if has_shades else None,
    }


MOST_CELLS: Final = 1_500_000
"""Limit of cells in all maps of a page together; maps of chosen targets come first."""
_MOST_LAYERED: Final = 50_000
"""Limit of cells of a map whose limiting conjuncts and blocking causes are on the page."""


class ReportedDecisions:
    """The decisions of a log and their gradient maps, collected message by message.

    Attributes:
        maps: gradient maps by the number that decisions refer to, in the order of the log.
    """

    def __init__(self) -> None:
        self.maps = dict[int, Grid]()
        self._decisions: list[PlanDecision] = []

    def add_decision(self, payload: bytes) -> None:
        """Add a decision, unless it cannot be decoded."""
        with suppress(LogError):
            self._decisions.append(decision_from_payload(payload))

    def add_map(self, number: int, payload: bytes) -> None:
        """Add a gradient map, unless it cannot be decoded."""
        with suppress(DecodeError):
            self.maps[number] = Grid.FromString(payload)

    @property
    def decisions(self) -> tuple[PlanDecision, ...]:
        """The decisions in order, each with its outcome if the log has it."""
        return latest_decisions(self._decisions)


class _Owner(NamedTuple):
    """The candidate that a map belongs to.

    Attributes:
        edge_index: index of the edge in the decision.
        candidate_index: index of the candidate in the edge.
        turn: turn of the object in radians.
        is_joint: whether the edge takes several motions.
    """

    edge_index: int
    candidate_index: int
    candidate: PlanCandidate
    turn: float
    is_joint: bool

    @property
    def target(self) -> PlanTarget | None:
        """The candidate's target, if this map has the orientation nearest to the target's; else None."""
        candidate = self.candidate
        if not candidate.HasField("target"):
            return None
        nearest_turn = min(
            (map_turn.turn for map_turn in candidate.maps), key=lambda turn: abs(turn - candidate.target.turn)
        )
        return candidate.target if nearest_turn == self.turn else None


class _Drawn(NamedTuple):
    """A gradient map as numbers.

    Attributes:
        values: (rows, columns), robustness, NaN where blocked.
        low, high: lower left and upper right corner.
        owner: candidate of the map; None if the log does not record the candidate.
        is_chosen: whether the decision's target was chosen on this map.
        fields: arrays (rows, columns) of the message by name.
    """

    values: Floats
    low: tuple[float, float]
    high: tuple[float, float]
    owner: _Owner | None
    is_chosen: bool
    fields: Mapping[str, NDArray[Any]]


def decisions_value(
    plan: ReportedDecisions,
    redone: ReportedDecisions,
    first_ns: int,
    packing: Packing,
    most_cells: int = MOST_CELLS,
) -> Mapping[str, Any]:
    """Return the decisions as the page's script reads them, and the number of maps left out.

    Args:
        redone: decisions of `plan --redo` that differ from the recorded decisions.
    """
    maps_by_decision = [list(_maps_of(plan, decision)) for decision in plan.decisions]
    kept_maps = _maps_that_fit([drawn_map for maps in maps_by_decision for drawn_map in maps], most_cells)
    redone_by_number = {redone_decision.number: redone_decision for redone_decision in redone.decisions}
    decisions = []
    for decision, maps in zip(plan.decisions, maps_by_decision, strict=True):
        map_values = [_map_value(drawn_map, packing) for drawn_map in maps if id(drawn_map) in kept_maps]
        facts = _decision_value(decision, map_values, first_ns, packing)
        redone_decision = redone_by_number.get(decision.number)
        if redone_decision is not None and _outcome(redone_decision) != _outcome(decision):
            redone_values = [
                _map_value(drawn_map, packing)
                for drawn_map in _maps_of(redone, redone_decision)
                if drawn_map.is_chosen
            ]
            facts["redone"] = _decision_value(redone_decision, redone_values, first_ns, packing)
        decisions.append(facts)
    return {"decisions": decisions, "maps_left_out": sum(map(len, maps_by_decision)) - len(kept_maps)}


def _outcome(decision: PlanDecision) -> tuple[object, ...]:
    return decision.kind, decision.reason, decision.time_ns


def _maps_that_fit(maps: Sequence[_Drawn], most_cells: int) -> set[int]:
    """Return the ids (`id`) of the maps within the limit. Maps of chosen targets come first."""
    kept_maps: set[int] = set()
    cell_count = 0
    for drawn_map in sorted(maps, key=lambda drawn_map: not drawn_map.is_chosen):
        if cell_count + drawn_map.values.size <= most_cells:
            cell_count += drawn_map.values.size
            kept_maps.add(id(drawn_map))
    return kept_maps


def _maps_of(plan: ReportedDecisions, decision: PlanDecision) -> Iterator[_Drawn]:
    """Yield the maps of a decision, or the maps of its time if the log does not record the owners of maps."""
    owners = {
        map_reference.number: _Owner(edge_index, candidate_index, candidate, map_reference.turn, edge.joint)
        for edge_index, edge in enumerate(decision.considered)
        for candidate_index, candidate in enumerate(edge.candidates)
        for map_reference in candidate.maps
    }
    owned_grids: list[tuple[_Owner | None, Grid]] = [
        (owner, plan.maps[number]) for number, owner in sorted(owners.items()) if number in plan.maps
    ]
    if not owners:
        owned_grids = [
            (None, grid)
            for _, grid in sorted(plan.maps.items())
            if grid.timestamp.ToNanoseconds() == decision.time_ns
        ]
    for owner, grid in owned_grids:
        drawn_map = _draw_map(grid, owner, _is_chosen(owner, decision, len(owned_grids)))
        if drawn_map is not None:
            yield drawn_map


def _is_chosen(owner: _Owner | None, decision: PlanDecision, map_count: int) -> bool:
    """Return whether a decision's target was chosen on a map.

    A map without an owner must be the decision's only map.
    """
    if not decision.HasField("target"):
        return False
    if owner is None:
        return map_count == 1
    is_last = owner.edge_index == len(decision.considered) - 1
    return is_last and owner.candidate.chosen and owner.target is not None


def _draw_map(grid: Grid, owner: _Owner | None, is_chosen: bool) -> _Drawn | None:
    """Return a map as numbers; None for a message with inconsistent or empty sizes."""
    fields = map_fields(grid)
    robustness = fields.get("robustness")
    if robustness is None:
        return None
    rows, columns = robustness.shape
    x, y = grid.pose.position.x, grid.pose.position.y
    high = x + columns * grid.cell_size.x, y + rows * grid.cell_size.y
    if not np.isfinite([x, y, *high]).all() or high[0] <= x or high[1] <= y:
        return None
    return _Drawn(robustness.astype(np.float64), (x, y), high, owner, is_chosen, fields)


def _map_value(drawn_map: _Drawn, packing: Packing) -> Mapping[str, Any]:
    finite = drawn_map.values[np.isfinite(drawn_map.values)]
    map_facts: dict[str, Any] = {
        "columns": drawn_map.values.shape[1],
        "low": drawn_map.low,
        "high": drawn_map.high,
        "scale": float(np.abs(finite).max(initial=0.0)),
        "values": packing.add(singles(drawn_map.values), "f4"),
        "chosen": drawn_map.is_chosen,
        "edge": None,
        "candidate": None,
        "object": "",
        "title": "",
        "target": None,
        "rule": "",
        "joint": False,
    }
    owner = drawn_map.owner
    if owner is None:
        return map_facts
    candidate = owner.candidate
    turn_text = f", turned by {math.degrees(owner.turn):.3g}°" if len(candidate.maps) > 1 else ""
    map_facts |= _layer_values(drawn_map, owner, packing)
    return map_facts | {
        "edge": owner.edge_index,
        "candidate": owner.candidate_index,
        "object": candidate.object,
        "title": f"{candidate.object}{turn_text}",
        "target": None if owner.target is None else _target_value(owner.target),
        "rule": candidate.rule,
        "joint": owner.is_joint,
    }


def _layer_values(drawn_map: _Drawn, owner: _Owner, packing: Packing) -> dict[str, Any]:
    """Return the limiting conjunct and the blocking cause of each cell, and layers of the chosen map."""
    if not {"limited_by", "blocked_by"} <= drawn_map.fields.keys() or drawn_map.values.size > _MOST_LAYERED:
        return {}
    candidate = owner.candidate
    numbered_conjuncts = [
        (number, f"{number}: {conjunct.text}", plain(demand_words(conjunct)))
        for number, conjunct in enumerate(candidate.conjuncts, 1)
    ]
    layers = [
        {"number": number, "title": title, "values": packing.add(drawn_map.fields[name], "f4")}
        for number, name, title in numbered_conjuncts
        if drawn_map.is_chosen and name in drawn_map.fields and np.ptp(drawn_map.fields[name]) != 0.0
    ]
    layer_facts: dict[str, Any] = {
        "limited": packing.add(drawn_map.fields["limited_by"], "u2"),
        "blocked": packing.add(drawn_map.fields["blocked_by"], "u2"),
        "limits": [sentence_parts(demand_words(conjunct)) for conjunct in candidate.conjuncts],
        "blocks": [sentence_parts(cause.words) for cause in candidate.causes],
        "layers": layers,
    }
    if owner.target is not None:
        layer_facts["at_target"] = [_finite(conjunct, "at_target") for conjunct in candidate.conjuncts]
    if drawn_map.is_chosen and candidate.HasField("least_way") and "way" in drawn_map.fields:
        layer_facts |= {"way": packing.add(drawn_map.fields["way"], "f4"), "least_way": candidate.least_way}
    if drawn_map.is_chosen and candidate.HasField("least_room") and "room" in drawn_map.fields:
        layer_facts |= {
            "room": packing.add(drawn_map.fields["room"], "f4"),
            "least_room": candidate.least_room,
        }
    return layer_facts


def _finite(message: Message, name: str) -> float | None:
    """Return a number of a message; None if it is absent or not finite."""
    number: float = getattr(message, name)
    return number if message.HasField(name) and math.isfinite(number) else None


def _decision_value(
    decision: PlanDecision, maps: Sequence[Mapping[str, Any]], first_ns: int, packing: Packing
) -> dict[str, Any]:
    aim = aim_of(decision)
    facts: dict[str, Any] = {
        **json_fields(decision, "number", "specification", "reason"),
        "time": (decision.time_ns - first_ns) / 1e9,
        "kind": kind_text(decision),
        "states": list(decision.states),
        "edges": [_edge_value(edge, edge is aim) for edge in decision.considered],
        "margin": _finite(decision, "margin"),
        "maps": maps,
        "target": _target_value(decision.target) if decision.HasField("target") else None,
        "outcome": None,
    }
    if decision.HasField("outcome"):
        outcome = decision.outcome
        facts["outcome"] = {
            **json_fields(outcome, "succeeded", "reason"),
            "time": (outcome.end_ns - first_ns) / 1e9,
            "states": list(outcome.states),
            "travelled": packing.add(np.array(outcome.travelled), "f8"),
        }
    return facts


def _edge_value(edge: PlanEdge, is_aim: bool) -> Mapping[str, Any]:
    return {
        "path": list(edge.path),
        "aim": is_aim,
        "wanted": [sentence_parts(sentence) for sentence in edge.wanted],
        "rules": [sentence_parts(sentence) for sentence in edge.rules],
        "candidates": [_candidate_value(candidate) for candidate in edge.candidates],
        "later": [f"{motion.object} to {_target_value(motion)['words']}" for motion in edge.motions[1:]],
        "once": joint_suffix(edge),
        "pruned": Reason.from_text(edge.pruned).kind,
    }


def _candidate_value(candidate: PlanCandidate) -> Mapping[str, Any]:
    largest_robustness = best_robustness(candidate)
    limit_bars = [
        (conjunct.limits, sentence_parts(demand_words(conjunct)))
        for conjunct in limiting_conjuncts(candidate)
    ]
    cause_bars = [(cause.cells, sentence_parts(cause.words)) for cause in candidate.causes]
    return {
        **json_fields(candidate, "object", "rejected"),
        "best": largest_robustness if math.isfinite(largest_robustness) else None,
        "status": "rejected" if candidate.rejected else "chosen" if candidate.chosen else "possible",
        "cells": sum(cells for cells, _ in (*limit_bars, *cause_bars)),
        "bars": [
            {"kind": kind, "words": words, "cells": cells}
            for kind, bars in (("limited by", limit_bars), ("blocked", cause_bars))
            for cells, words in bars[:MOST_LISTED]
        ],
        "room": room_sentence(candidate),
        "target": _target_value(candidate.target) if candidate.HasField("target") else None,
    }


def _target_value(target: PlanTarget) -> Mapping[str, Any]:
    """Return a target in words, with the points of its path if all are finite."""
    points = [target.x, target.y, *target.waypoints]
    is_drawn = bool(np.isfinite(points).all())
    turn_text = f", turned by {math.degrees(target.turn):.3g}°" if target.turn else ""
    return {
        "object": target.object,
        "at": points[:2] if is_drawn else None,
        "words": f"({target.x:.4g}, {target.y:.4g}){turn_text}",
        "turn": target.turn,
        "robustness": _finite(target, "robustness"),
        "way": points[2:] if is_drawn else [],
    }
