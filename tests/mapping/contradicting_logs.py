"""Small logs for each assumption: some that contradict it, and some that only look like it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from math import cos, radians, sin
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.writer import Writer as McapWriter
from mcap_protobuf.schema import build_file_descriptor_set

from spatial_replay import Trace, read_trace

BEGIN_NS = 1_790_000_000_000_000_000
ODOMETRY = "nav_msgs/msg/Odometry"


class Said(NamedTuple):
    """A message; its times are in seconds from `BEGIN_NS`, or in full as ns."""

    log: float | int
    content: Any
    topic: str = "/t"
    channel: int = 0
    published: float | int | None = None
    type: str = "Thing"


class Case(NamedTuple):
    """A log, its mapping, and whether it contradicts an assumption."""

    assumption: str
    contradicts: bool
    label: str
    mapping: str
    messages: list[Said]


def read(folder: Path, mapping: str, messages: list[Said]) -> Trace:
    """Write the messages as an MCAP log of JSON and protobuf, and read it by a mapping."""
    log, text = folder / "log.mcap", folder / "m.yaml"
    text.write_text(mapping)
    with log.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        channels: dict[tuple[str, int], int] = {}
        for message in messages:
            is_json = isinstance(message.content, dict)
            key = message.topic, message.channel
            if key not in channels:
                kind, encoding, schema = message.type, "jsonschema", b'{"type": "object"}'
                if not is_json:
                    kind, encoding = message.content.DESCRIPTOR.full_name, "protobuf"
                    schema = build_file_descriptor_set(type(message.content)).SerializeToString()
                number = writer.register_schema(kind, encoding, schema)
                channels[key] = writer.register_channel(
                    message.topic, "json" if is_json else "protobuf", number
                )
            content = message.content
            payload = json.dumps(content).encode() if is_json else content.SerializeToString()
            log_ns = _ns(message.log)
            published = log_ns if message.published is None else _ns(message.published)
            writer.add_message(channels[key], log_ns, payload, published)
        writer.finish()
    return read_trace(log, mapping=text, allow_damage=True)


def _ns(time: float) -> int:
    return time if isinstance(time, int) else BEGIN_NS + round(time * 1e9)


def _run(contents: Any, *, step: float = 0.1, **more: Any) -> list[Said]:
    """Return messages that come every `step` seconds."""
    return [Said(number * step, content, **more) for number, content in enumerate(contents)]


def _stamped(seconds: float, frame: str = "map", **fields: Any) -> dict[str, Any]:
    stamp_ns = BEGIN_NS + round(seconds * 1e9)
    stamp = {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}
    return {"header": {"stamp": stamp, "frame_id": frame}, **fields}


def _circle(number: int, radius: float = 5.0) -> tuple[float, float, float]:
    """Return a place on a circle and the course there, in degrees from x."""
    turn = 10.0 * number
    return radius * cos(radians(turn)), radius * sin(radians(turn)), turn + 95.0


BOT = "topics: {/t: {name: bot, position: [x, y], shape: {disc: 0.3}}}"
TURNING = "topics: {/t: {name: bot, position: [x, y], yaw: yaw, shape: {box: [1, 0.5]}}}"
DEGREES = "topics: {/t: {name: bot, position: [x, y], yaw: {field: yaw, unit: deg}, shape: {box: [1, 0.5]}}}"
LISTED = "topics: {/t: {objects: 'of[*]', name: 't{id}', position: [x, y], shape: {disc: 0.3}}}"
QUATERNIONS = "topics: {/t: {name: bot, position: [x, y], orientation: q, order: xyzw, shape: {box: [2, 1]}}}"
FIXES = (
    "origin: [52, 5]\ntopics: {/t: {name: boat, position: [latitude, longitude],"
    " yaw: {field: heading, unit: deg}, shape: {box: [10, 2]}}}"
)
TWO = (
    "topics: {/t: {name: bot, position: [x, y], shape: {disc: 0.3}},"
    " /u: {name: other, position: [x, y], shape: {disc: 0.3}}}"
)
HEADER = f"clock: header\n{BOT}"
FRAMES = f"fixed_frame: map\n{TWO}"
SIGNAL = "topics: {/t: {signals: {voltage: v}}}"


def straight(count: int = 20, **more: float) -> list[dict[str, float]]:
    return [{"x": 0.1 * number, "y": 0.0, **more} for number in range(count)]


def _times() -> Iterator[Case]:
    micro = BEGIN_NS // 1000
    yield Case(
        "log_time_unit", True, "us", BOT, [Said(micro + k * 100_000, c) for k, c in enumerate(straight())]
    )
    burst = [1_500_000_000 + k // 10 * 10**8 + k % 10 * 50_000 for k in range(40)]
    simulated = [Said(time, content) for time, content in zip(burst, straight(40), strict=True)]
    yield Case("log_time_unit", False, "bursts in simulated time", BOT, simulated)

    unset = [Said(0, content, published=0.1 * k) for k, content in enumerate(straight())]
    yield Case("log_times_set", True, "0", BOT, unset)
    yield Case("log_times_set", False, "two messages at once", BOT, unset[:2])

    def stamps(stop: float, until: float) -> list[Said]:
        def stamp(time: float) -> float:
            return time if not stop < time < until else stop

        return _run((_stamped(stamp(0.05 * k), x=0.1 * k, y=0.0) for k in range(80)), step=0.05)

    yield Case("stamps_advance", True, "stop for 2 s", HEADER, stamps(1.0, 3.0))
    yield Case("stamps_advance", False, "one frame late", HEADER, stamps(1.0, 1.2))
    yield Case("stamps_advance", False, "not used", BOT, stamps(1.0, 3.0))

    def counted(factor: float) -> list[Said]:
        return _run({"x": 0.1 * k, "y": 0.0, "ms": round((5000 + 100 * k) * factor)} for k in range(40))

    counts = HEADER.replace("name: bot", "name: bot, stamp: {field: ms, unit: ms}")
    yield Case("stamp_unit", True, "microseconds as milliseconds", counts, counted(1000.0))
    yield Case("stamp_unit", False, "a slow simulation", counts, counted(0.05))

    def clocks(late: Any) -> list[Said]:
        both = [
            (
                Said(0.1 * k, _stamped(0.1 * k, x=k, y=0)),
                Said(0.1 * k, _stamped(0.1 * k - late(k), x=k, y=5), "/u"),
            )
            for k in range(40)
        ]
        return [message for pair in both for message in pair]

    random = Random(1)
    yield Case("one_clock", True, "18 s ahead, as of satellites", FRAMES, clocks(lambda k: -18.0))
    yield Case("one_clock", True, "from a start", FRAMES, clocks(lambda k: BEGIN_NS / 1e9 - 0.2 * k))
    yield Case(
        "one_clock", False, "computed for 8 s", FRAMES, clocks(lambda k: 8.0 + random.uniform(-1.0, 1.0))
    )
    latched = [Said(0.0, _stamped(-7200.0, x=1, y=1), "/u"), *clocks(lambda k: 0.0)[::2]]
    yield Case("one_clock", False, "an old map", FRAMES, latched)


def _poses() -> Iterator[Case]:
    def quaternions(*listed: tuple[float, ...]) -> list[Said]:
        return _run({"x": 0.1 * k, "y": 0.0, "q": list(q)} for k, q in enumerate(listed))

    half = [radians(3.0 * k) for k in range(40)]
    yield Case(
        "quaternion_order",
        True,
        "w first",
        QUATERNIONS,
        quaternions(*((cos(a), 0.0, 0.0, sin(a)) for a in half)),
    )
    yield Case(
        "quaternion_order",
        False,
        "w last",
        QUATERNIONS,
        quaternions(*((0.0, 0.0, sin(a), cos(a)) for a in half)),
    )
    tags = ((1.0, 0.03 * sin(k), 0.02 * cos(k), 0.04 * sin(3 * k)) for k in range(40))
    yield Case("quaternion_order", False, "tags upside down", QUATERNIONS, quaternions(*tags))
    side = ((0.5, 0.5, 0.5, 0.5) for _ in range(40))
    yield Case("quaternion_order", False, "on its side in both", QUATERNIONS, quaternions(*side))

    angles = quaternions(*((0.0, 0.0, 0.5 + 0.05 * k, 0.0) for k in range(40)))
    yield Case("quaternion_length", True, "angles instead", QUATERNIONS, angles)
    lone = [(0.0, 0.0, 0.0, 1.0)] * 70 + [(0.1, 0.3, 0.0, 0.2)]
    yield Case("quaternion_length", False, "one of many is odd", QUATERNIONS, quaternions(*lone))

    yield Case("quaternion_scale", True, "5, 6, 7, 8", QUATERNIONS, quaternions(*[(5.0, 6.0, 7.0, 8.0)] * 9))
    yield Case("quaternion_scale", False, "rounded", QUATERNIONS, quaternions(*[(0.0, 0.0, 0.7, 0.7)] * 9))

    def turning(*turns: float, mapping: str = TURNING) -> tuple[str, list[Said]]:
        return mapping, _run({"x": 1.0, "y": 2.0, "yaw": turn} for turn in turns)

    yield Case("radians", True, "degrees that jump", *turning(*([90.0] * 10 + [180.0] * 10)))
    yield Case("radians", True, "degrees that grow", *turning(*(2.0 * k for k in range(90))))
    yield Case("radians", False, "turns are counted", *turning(*(0.1 * k for k in range(400))))
    yield Case("one_turn", True, "turns are counted", *turning(*(0.1 * k for k in range(100))))
    yield Case("one_turn", False, "up to 2 pi", *turning(*(0.062 * k for k in range(100))))
    hundredths = [100.0 * (k * 10 % 360) for k in range(72)]
    in_hundredths = DEGREES.replace("unit: deg", "unit: cdeg")
    yield Case("degrees", True, "hundredths", *turning(*hundredths, mapping=DEGREES))
    yield Case("degrees", False, "read as hundredths", *turning(*hundredths, mapping=in_hundredths))
    yield Case("degrees", True, "511", *turning(*([90.0] * 10 + [511.0] * 5), mapping=DEGREES))
    yield Case(
        "degrees", False, "turns are counted", *turning(*(5.0 * k for k in range(200)), mapping=DEGREES)
    )

    def driving(yaw: Any, mapping: str = TURNING) -> tuple[str, list[Said]]:
        places = [_circle(k) for k in range(36)]
        return mapping, _run({"x": x, "y": y, "yaw": yaw(course)} for x, y, course in places)

    yield Case("heading", True, "from north, clockwise", *driving(lambda course: radians(90 - course)))
    yield Case("heading", False, "backwards", *driving(lambda course: radians(course + 180)))
    yield Case("heading", False, "does not turn", *driving(lambda course: 0.3))
    yield Case("heading", False, "looks inwards", *driving(lambda course: radians(course + 90)))
    sideways = TURNING.replace("yaw: yaw", "yaw: heading")
    drifting = _run({"x": 0.0, "y": 0.1 * k, "heading": 0.0} for k in range(40))
    yield Case("heading", False, "sideways", sideways, drifting)

    def sailing(north: float, east: float, heading: float) -> tuple[str, list[Said]]:
        fixes = ((52 + north * k * 1e-5, 5 + east * k * 1e-5) for k in range(30))
        return FIXES, _run(
            {"latitude": latitude, "longitude": longitude, "heading": heading}
            for latitude, longitude in fixes
        )

    yield Case("compass", True, "at anchor", *sailing(0.0, 0.0, 30.0))
    yield Case("compass", False, "along it", *sailing(1.0, 0.0, 90.0))
    heights = [{"x": cos(k), "y": 1.7, "z": 3 * sin(k)} for k in range(30)]
    solid = BOT.replace("[x, y]", "[x, y, z]")
    yield Case("upward", True, "z is one of two", solid, _run(heights))
    yield Case("upward", False, "a drone", solid, _run({**at, "y": 0.1 * k} for k, at in enumerate(heights)))


def _places() -> Iterator[Case]:
    def fixes(north: float, east: float = 5.0, scale: float = 1.0) -> list[Said]:
        return _run(
            {"latitude": (north + k * 1e-5) * scale, "longitude": east * scale, "heading": 90.0}
            for k in range(30)
        )

    lat = "topics: {/t: {name: bot, position: [lat, lon], shape: {disc: 0.3}}}"
    yield Case("metres", True, "degrees", lat, _run({"lat": 48 + k * 1e-5, "lon": 11.0} for k in range(30)))
    polar = BOT.replace("[x, y]", "[range, bearing_deg]")
    yield Case("metres", True, "an angle", polar, _run({"range": 20.0, "bearing_deg": k} for k in range(30)))
    yield Case("metres", False, "a radar", lat, _run({"lat": -3.5, "lon": 80.0 - k} for k in range(30)))
    yield Case("latitude", True, "times 1e7", FIXES, fixes(52.0, scale=1e7))
    away = [Said(0.1 * k, {"latitude": 91.0, "longitude": 181.0, "heading": 90.0}) for k in range(5)]
    unavailable = [*away, *(fix._replace(log=fix.log + 1.0) for fix in fixes(52.0))]
    yield Case(
        "latitude",
        False,
        "numbers for not available",
        FIXES.replace("{name", "{invalid: [91, 181], name"),
        unavailable,
    )
    yield Case("latitude", False, "near the pole", FIXES.replace("52,", "89,"), fixes(89.99))
    yield Case("origin", True, "of another town", FIXES, fixes(55.0))
    yield Case("origin", False, "a degree away", FIXES, fixes(52.9))

    def utm(step: float, begin: float) -> list[Said]:
        return _run({"x": begin + step * k, "y": 0.0} for k in range(30))

    yield Case("precision", True, "UTM in float32", BOT, utm(0.5, 5_334_567.0))
    yield Case("precision", False, "UTM in float64", BOT, utm(0.01, 5_334_567.0))
    yield Case("precision", False, "whole pixels", BOT, utm(2.0, 20_000.0))

    def odometry(variance: float) -> list[Said]:
        covariance = [variance * (k % 7 == 0) for k in range(36)]
        turn = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        poses = ({"position": {"x": 0.1 * k, "y": 0.0, "z": 0.0}, "orientation": turn} for k in range(20))
        return _run(
            (
                _stamped(0.1 * k, pose={"pose": pose, "covariance": covariance})
                for k, pose in enumerate(poses)
            ),
            type=ODOMETRY,
        )

    uncertain = "topics: {/t: {name: bot, shape: {disc: 0.3}, uncertainty: covariance}}"
    yield Case("covariance", True, "zeros", uncertain, odometry(0.0))
    yield Case("covariance", False, "small", uncertain, odometry(1e-6))

    def unit(x: float, size: float) -> list[Said]:
        parked = [Said(0.1 * k, {"x": 1.0 + 0.001 * sin(k), "y": 0.0, "size": 0.3}, "/u") for k in range(40)]
        return [*parked, *_run({"x": x * k, "y": 2 * x, "size": size} for k in range(40))]

    sized = TWO.replace("disc: 0.3", "disc: size")
    yield Case("one_unit", True, "millimetres", sized, unit(100.0, 300.0))
    yield Case("one_unit", True, "places in millimetres", TWO, unit(100.0, 0.3))
    yield Case("one_unit", True, "alone", BOT, _run({"x": 70.0 * k, "y": 0.0} for k in range(40)))
    late = [Said(2.0 * (k // 20) + 2e-5 * (k % 20), {"x": 0.1 * k, "y": 0.0}) for k in range(200)]
    yield Case("one_unit", False, "recorded in bursts", TWO, [*late, *unit(0.0, 0.3)[:40]])
    yield Case("one_unit", False, "a lorry in a parked fleet", sized, unit(2.5, 12.0))

    def framed(other: str) -> list[Said]:
        return [
            message
            for k in range(10)
            for message in (
                Said(0.1 * k, _stamped(0.1 * k, x=0.1 * k, y=0.0)),
                Said(0.1 * k, _stamped(0.1 * k, other, x=5.0, y=0.0), "/u"),
            )
        ]

    yield Case("one_frame", True, "map and odom", TWO, framed("odom"))
    yield Case("one_frame", False, "with a slash before it", TWO, framed("/map"))


def _names() -> Iterator[Case]:
    def sent(channels: list[int], far: float) -> list[Said]:
        return [
            Said(0.1 * k, {"x": 0.1 * k + far * channel, "y": 0.0}, channel=channel)
            for k, channel in enumerate(channels)
        ]

    yield Case("one_publisher", True, "two robots", BOT, sent([0, 1] * 20, 0.0))
    slow = [int(k % 25 == 24) for k in range(200)]
    yield Case("one_publisher", True, "one is slow", BOT, sent(slow, 0.0))
    yield Case("one_publisher", False, "files of a bag", BOT, sent([k // 10 for k in range(80)], 0.0))
    yield Case(
        "one_publisher", False, "hands over, and takes back", BOT, sent([0] * 9 + [1] * 9 + [0] * 9, 0.0)
    )

    def at(*places: float, step: float = 0.1) -> list[Said]:
        return _run(({"x": x, "y": 0.0} for x in places), step=step)

    yield Case("one_object", True, "two", BOT, at(*(0.01 * k + 30.0 * (k % 2) for k in range(40))))
    yield Case("one_object", True, "three in turn", BOT, at(*(0.01 * k + 9.0 * (k % 3) for k in range(40))))
    yield Case("one_object", False, "trembles", BOT, at(*(0.2 * (k % 2) for k in range(40))))
    random = Random(2)
    yield Case("one_object", False, "noise", BOT, at(*(random.gauss(0.0, 2.0) for _ in range(500))))
    yield Case(
        "one_object", False, "is placed again", BOT, at(*(0.1 * k + 30.0 * (k > 9) for k in range(40)))
    )
    yield Case("one_object", False, "a shuttle", BOT, at(*(8.0 * (k % 2) for k in range(40)), step=10.0))

    def lists(*listed: Any) -> list[Said]:
        return _run(
            {"of": [{"id": i, "x": 0.1 * k, "y": 5.0 * i} for i in numbers]}
            for k, numbers in enumerate(listed)
        )

    yield Case("complete_list", True, "halves", LISTED, lists(*([(0, 1), (2, 3)] * 10)))
    missed = lists(*((0, 1) if k % 3 == 1 else (0, 1, 2, 3) for k in range(40)))
    yield Case("complete_list", False, "missed now and then", LISTED, missed)
    seldom = lists(*((0,) if k % 30 == 0 else () for k in range(900)))
    yield Case("complete_list", False, "seldom", LISTED, seldom)

    classes = LISTED.replace("position", "class: {field: kind}, position")

    def tracks(*kinds: str) -> list[Said]:
        return _run(
            {"of": [{"id": i, "x": k, "y": i, "kind": kind} for i, kind in enumerate(kinds[k % 2 :: 2])]}
            for k in range(10)
        )

    yield Case("one_class", True, "changes", classes, tracks("car", "bus"))
    yield Case("one_class", False, "one of each", classes, tracks("car", "car", "bus", "bus"))

    unnamed = "topics: {/t: {objects: 'of[*]', position: [x, y], shape: {disc: 0.3}}}"
    yield Case(
        "places",
        True,
        "no ids",
        unnamed,
        _run({"of": [{"x": 1.0, "y": 2.0 * k} for k in range(2)]} for _ in range(5)),
    )
    yield Case(
        "places", False, "ids", unnamed.replace("position", "name: 't{id}', position"), lists(*[(1, 2)] * 5)
    )

    far = [*straight(20), {"x": 300.0, "y": 0.0}, {"x": 300.1, "y": 0.0}]
    yield Case("motion", True, "is far away at once", BOT, _run(far))
    lost = [{"x": 0.0, "y": 0.0} if k % 10 > 7 else {"x": 9 + 0.01 * k, "y": 5.0} for k in range(40)]
    yield Case("motion", True, "is at (0, 0) where it is lost", BOT, _run(lost))
    from_zero = [{"x": 0.01 * k, "y": 0.0} for k in range(40)]
    yield Case("motion", False, "begins at (0, 0)", BOT, _run(from_zero))

    def absent(after: float) -> list[Said]:
        seen = [k for k in range(120) if not 40 < k < 80]
        places = {k: 0.1 * k + (after if k >= 80 else 0.0) for k in seen}
        return _run({"of": [{"id": 1, "x": places[k], "y": 0.0}] if k in places else []} for k in range(120))

    yield Case("motion", True, "an id is used again", LISTED, absent(15.0))
    yield Case("motion", False, "an object is hidden for a while", LISTED, absent(0.0))
    yield Case("motion", False, "accelerates", BOT, _run({"x": 0.001 * k * k, "y": 0.0} for k in range(60)))


def _shapes() -> Iterator[Case]:
    bounds = LISTED.replace("position: [x, y], shape: {disc: 0.3}", "bounds: box")

    def boxes(box: Any) -> list[Said]:
        return _run({"of": [{"id": 1, "box": box(300.0 + 9 * k, 200.0 + 5 * k)}]} for k in range(20))

    yield Case("corners", True, "x, y, w, h", bounds, boxes(lambda x, y: [x, y, 50.0, 80.0]))
    yield Case(
        "corners", False, "left, top, right, bottom", bounds, boxes(lambda x, y: [x, y, x + 50, y + 80])
    )
    yield Case(
        "corners", False, "right, bottom, left, top", bounds, boxes(lambda x, y: [x + 50, y + 80, x, y])
    )

    sized = LISTED.replace("{disc: 0.3}", "{box: [l, w]}")

    def sizes(length: float, width: float) -> list[Said]:
        return _run({"of": [{"id": 1, "x": 0.1 * k, "y": 0, "l": length, "w": width}]} for k in range(9))

    yield Case("extent", True, "0", sized, sizes(0.0, 0.0))
    yield Case("extent", False, "a wall", sized, sizes(4.0, 0.0))

    polygons = LISTED.replace("position: [x, y], shape: {disc: 0.3}", "polygon: corners")

    def outlines(*corners: tuple[float, float]) -> list[Said]:
        return _run({"of": [{"id": 1, "corners": [list(corner) for corner in corners]}]} for _ in range(5))

    yield Case("outlines", True, "two corners", polygons, outlines((0, 0), (1, 0)))
    yield Case("outlines", False, "three", polygons, outlines((0, 0), (1, 0), (0, 1)))

    named = "topics: {/t: {name: bot, shape: {disc: 0.3}}}"
    unset, zero = PoseInFrame(frame_id="map"), PoseInFrame(frame_id="map")
    unset.pose.orientation.w = zero.pose.orientation.w = 1.0
    zero.pose.position.x = 0.0
    yield Case("fields_set", True, "no position", named, _run([zero, unset, zero]))
    yield Case("fields_set", False, "at 0", named, _run([zero, zero, zero]))

    dictionaries = QUATERNIONS.replace(" order: xyzw,", "")

    def turned(*lengths: float) -> list[Said]:
        return _run(
            {"x": 0.1 * k, "y": 0.0, "q": {"x": 0.0, "y": 0.0, "z": 0.0, "w": w}}
            for k, w in enumerate(lengths)
        )

    yield Case("orientation_set", True, "some are zeros", dictionaries, turned(1.0, 1.0, 0.0, 0.0, 1.0))
    yield Case("orientation_set", False, "all are zeros", dictionaries, turned(0.0, 0.0, 0.0))

    def voltages(*values: float) -> list[Said]:
        return _run({"v": value} for value in values)

    random = Random(3)
    two = (12.0 + 8.0 * (k % 2) + 0.01 * random.random() for k in range(60))
    yield Case("one_series", True, "two batteries", SIGNAL, voltages(*two))
    yield Case("one_series", False, "a heartbeat", SIGNAL, voltages(*(float(k % 2) for k in range(60))))
    yield Case("one_series", False, "noise", SIGNAL, voltages(*(random.gauss(12.0, 1.0) for _ in range(60))))


CASES = [*_times(), *_poses(), *_places(), *_names(), *_shapes()]
