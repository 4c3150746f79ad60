"""Damaged logs of every format: typed errors, no silently changed verdict, and full recovery."""

from __future__ import annotations

import gzip
import io
import json
import random
import zlib
from base64 import b64decode, b64encode
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from mcap.reader import make_reader

from attacks.cases import Case, Outcome
from attacks.program import Said, problems_of, said_by

SPECIFICATION = "spec near = G (a dist b <= 6.5)\nspec past = F (a rightof b)\nspec both = near and past\n"
MAPPING = """\
sample: {topic: /b/pose}
topics:
  /a/pose: {shape: {disc: 0.4}}
  /b/pose: {shape: {disc: 0.4}}
"""
_JSON_MAPPING = """\
sample: {topic: /b/pose}
topics:
  /a/pose: {position: [x, y], shape: {disc: 0.4}}
  /b/pose: {position: [x, y], shape: {disc: 0.4}}
"""
COUNT = 120
_NUMBERS = (b"NaN", b"1e999", b"-1", b"null", b"[]", b'"', b"9" * 30, b"1e-320", b"\xff", b"{}", b"")


class Format(NamedTuple):
    """A format of logs.

    Attributes:
        write: writes the log into a folder; returns its file or folder.
        mapping: mapping for reading the log.
        is_checked: whether checksums cover the samples, so that no verdict may change silently.
        is_text: whether the format is text.
        recovers: whether `recover` accepts the format.
        names: names of the two objects.
    """

    write: Callable[[Path], Path]
    mapping: str | None = None
    is_checked: bool = False
    is_text: bool = False
    recovers: bool = True
    names: tuple[str, str] = ("a", "b")


class Damage:
    """A log with random edits of its bytes, read by several commands."""

    name = "damage"
    most_cpu_s = 5.0
    uses_files = True

    def ready(self) -> None:
        for kind in FORMATS:
            with TemporaryDirectory(prefix="campaign-") as folder:
                self.run({"format": kind, "edits": [], "more": "all"}, Path(folder))

    def draw(self, rng: random.Random) -> Case:
        kind = rng.choice(sorted(FORMATS))
        files = _files(kind)
        edits = []
        for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
            name = rng.choice(sorted(files))
            edits.append([name, *_edit(rng, files[name], is_text=FORMATS[kind].is_text)])
        more = rng.choice(("", "", "info", "recover", "recover", "verify", "annotate", "explain", "suggest"))
        return {"format": kind, "edits": edits, "more": more}

    def kept(self, case: Case, folder: Path) -> Case:
        """See `Attack`; the stored form has the bytes of the damaged log."""
        files = {name: b64encode(zlib.compress(data)).decode() for name, data in _damaged(case).items()}
        return {**case, "files": files}

    def run(self, case: Case, folder: Path) -> Outcome:
        kind, form = case["format"], FORMATS[case["format"]]
        log = _placed(case, folder)
        (folder / "s.spatial").write_text(_specification(kind))
        mapped = []
        if form.mapping is not None:
            (folder / "m.yaml").write_text(form.mapping)
            mapped = ["--mapping", str(folder / "m.yaml")]
        spec = ["--spec", str(folder / "s.spatial")]
        replayed = said_by(["replay", str(log), *mapped, *spec, "--json", "-"])
        outcome = Outcome(problems_of(replayed), {f"exit {replayed.code}": 1})
        found, expected = verdicts_of(replayed), _expected(kind)
        if found is not None and found != expected and not replayed.said and replayed.code not in (2, 3):
            if form.is_checked:
                outcome.problems.append(f"{expected} became {found} without a remark")
            outcome.counts["unchecked changes"] = int(not form.is_checked)
        if case["more"] in ("recover", "all") and form.recovers:
            outcome.problems += _recovered(log, folder, [*mapped, *spec], found, kind)
        out = ["-o", str(folder / "copy.mcap")]
        commands = {
            "info": [["info", str(log), *mapped]],
            "verify": [["verify", str(log)]] if kind in ("ours", "annotated") else [],
            "explain": [["explain", str(log), *mapped, *spec, "--json"]],
            "suggest": [["info", str(log), "--suggest-mapping"]] if form.mapping else [],
            "annotate": [["replay", str(log), *mapped, *spec, *out], ["info", out[1]]],
        }
        more = commands.values() if case["more"] == "all" else [commands.get(case["more"], [])]
        for arguments in (each for several in more for each in several):
            if arguments[-1] == out[1] and arguments[0] == "info":
                if not Path(out[1]).exists():
                    continue
                said = said_by(arguments)
                if said.code == 3:
                    outcome.problems.append(f"the annotated copy is damaged, too: {said.said[:300]}")
            else:
                said = said_by(arguments)
            outcome.problems += problems_of(said)
        return outcome


def _recovered(log: Path, folder: Path, options: list[str], found: Any, kind: str) -> list[str]:
    """Recover a log, and recover the result again; return the problems of both."""
    form = FORMATS[kind]
    once, twice = folder / "once.mcap", folder / "twice.mcap"
    first = said_by(["recover", str(log), "-o", str(once)])
    problems = problems_of(first)
    if not once.exists():
        return problems
    second = said_by(["recover", str(once), "-o", str(twice)])
    problems += problems_of(second)
    if second.code != 0 or once.read_bytes() != twice.read_bytes():
        problems.append(f"recovered again it is another log (exit code {second.code}): {second.said[:300]}")
    replayed = said_by(["replay", str(once), *options, "--json", "-"])
    problems += problems_of(replayed)
    # without a checksum, a message that is wrong inside is copied as it is
    if replayed.code == 3 and found is not None and form.is_checked:
        problems.append(f"what was recovered is damaged: {replayed.said[:300]}")
    if form.is_checked and not messages_of(once.read_bytes()) <= _sound_messages(kind):
        problems.append("what was recovered has messages that the undamaged log has not")
    saved = verdicts_of(replayed)
    # of a damaged database, reading all topics may give a row more than reading some
    if found is not None and saved is not None and saved != found and saved[0] <= found[0]:
        problems.append(f"the damaged log gives {found}, the recovered one {saved}")
    return problems


def verdicts_of(said: Said) -> list[list[Any]] | None:
    """Return name, verdict and robustness of each result in the printed JSON of a replay, if there is one."""
    try:
        document = json.loads(said.printed)
    except ValueError:
        return None
    results = [[each["name"], each["verdict"], each["robustness"]] for each in document["specifications"]]
    return [[document["log"]["samples"]], *results]


def _edit(rng: random.Random, data: bytes, *, is_text: bool) -> list[Any]:
    """Return a random edit: its name, position and arguments."""
    at = rng.randrange(max(1, len(data)))
    length = min(len(data) - at, rng.choice((1, 2, 8, 100, 4096)))
    kinds = ["flip", "flip", "flip", "byte", "cut", "zero", "remove", "insert", "repeat", "length", "swap"]
    kind = rng.choice([*kinds, *(["number", "number", "line"] if is_text else [])])
    match kind:
        case "flip":
            return [kind, at, rng.randrange(8)]
        case "byte":
            return [kind, at, rng.randrange(256)]
        case "insert":
            return [kind, at, rng.randbytes(rng.choice((1, 4, 64))).hex()]
        case "length":
            return [kind, at, rng.choice(("ff" * 8, "ff" * 4, "00" * 8, "ffffff7f", "0000000000000080"))]
        case "swap":
            return [kind, at, rng.randrange(max(1, len(data))), length]
        case "number":
            return [kind, at, rng.choice(_NUMBERS).hex()]
    return [kind, at, length]


def edited(data: bytes, kind: str, at: int, *what: Any) -> bytes:
    """Return data after an edit."""
    match kind, what:
        case "flip", (bit,):
            return data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :] if at < len(data) else data
        case "byte", (value,):
            return data[:at] + bytes([value]) + data[at + 1 :]
        case "cut", _:
            return data[:at]
        case "zero", (length,):
            return data[:at] + bytes(length) + data[at + length :]
        case "remove", (length,):
            return data[:at] + data[at + length :]
        case "insert", (inserted,):
            return data[:at] + bytes.fromhex(inserted) + data[at:]
        case "repeat", (length,):
            return data[: at + length] + data[at:]
        case "length", (value,):
            return data[:at] + bytes.fromhex(value) + data[at + len(value) // 2 :]
        case "swap", (other, length):
            first, second = sorted((at, other))
            length = min(length, second - first)
            one, two = data[first : first + length], data[second : second + length]
            return data[:first] + two + data[first + length : second] + one + data[second + length :]
        case "number", (value,):
            # the number, or the word, that begins at or after the place
            begin = next((n for n in range(at, len(data)) if data[n : n + 1].isalnum()), len(data))
            end = next((n for n in range(begin, len(data)) if not data[n : n + 1].isalnum()), len(data))
            return data[:begin] + bytes.fromhex(value) + data[end:]
        case "line", _:
            begin, end = data.rfind(b"\n", 0, at) + 1, data.find(b"\n", at) + 1 or len(data)
            return data[:begin] + data[end:]
    raise ValueError(f"no edit is named {kind}")


def _damaged(case: Case) -> dict[str, bytes]:
    if "files" in case:
        return {name: zlib.decompress(b64decode(data)) for name, data in case["files"].items()}
    files = dict(_files(case["format"]))
    for name, *edit in case["edits"]:
        files[name] = edited(files[name], *edit)
    return files


def _placed(case: Case, folder: Path) -> Path:
    """Write the files of a case; return the path of the log."""
    for name, data in _damaged(case).items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
    return folder / sorted(_files(case["format"]))[0].split("/")[0]


def messages_of(log: bytes) -> set[tuple[str, int, bytes]]:
    """Return topic, time and bytes of each message of an MCAP log."""
    found = make_reader(io.BytesIO(log)).iter_messages(log_time_order=False)
    return {(channel.topic, message.log_time, message.data) for _, channel, message in found}


@cache
def _sound_messages(kind: str) -> set[tuple[str, int, bytes]]:
    (log,) = _files(kind).values()
    return messages_of(log)


@cache
def _files(kind: str) -> dict[str, bytes]:
    """Return the bytes of an undamaged log by the names of its files."""
    with TemporaryDirectory(prefix="campaign-") as temporary:
        path = FORMATS[kind].write(Path(temporary))
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        return {str(each.relative_to(path.parent)): each.read_bytes() for each in files}


def _specification(kind: str) -> str:
    first, second = FORMATS[kind].names
    return SPECIFICATION.replace("a dist b", f'"{first}" dist "{second}"').replace(
        "a rightof b", f'"{first}" rightof "{second}"'
    )


@cache
def _expected(kind: str) -> list[list[Any]]:
    with TemporaryDirectory(prefix="campaign-") as temporary:
        log = _placed({"format": kind, "edits": []}, Path(temporary))
        (spec := Path(temporary) / "s.spatial").write_text(_specification(kind))
        arguments = ["replay", str(log), "--spec", str(spec), "--json", "-"]
        if (text := FORMATS[kind].mapping) is not None:
            (mapping := Path(temporary) / "m.yaml").write_text(text)
            arguments += ["--mapping", str(mapping)]
        said = said_by(arguments)
        found = verdicts_of(said)
        if found is None or said.said:
            raise RuntimeError(f"the undamaged log of format {kind} cannot be replayed: {said.said}")
        return found


def _places(index: int) -> tuple[tuple[float, float], tuple[float, float]]:
    return (0.1 * index - 2.0, 1.0), (3.0, 0.02 * index)


def _tracks(folder: Path) -> Path:
    lines = []
    for index in range(COUNT):
        objects = [
            {
                "name": name,
                "class": "block",
                "polygon": [[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]],
                "yaw": 0.1,
            }
            for name, (x, y) in zip("ab", _places(index), strict=True)
        ]
        lines.append(json.dumps({"time_ns": index * 10**8, "objects": objects, "signals": {"battery": 0.8}}))
    path = folder / "run.jsonl"
    path.write_text("\n".join(lines) + "\n")
    return path


def _packed_tracks(folder: Path) -> Path:
    path = folder / "run.jsonl.gz"
    path.write_bytes(gzip.compress(_tracks(folder).read_bytes(), mtime=0))
    return path


def _csv(folder: Path) -> Path:
    rows = ["time_ns,name,class,x,y,yaw,length,width"]
    for index in range(COUNT):
        for name, (x, y) in zip("ab", _places(index), strict=True):
            rows.append(f"{index * 10**8},{name},block,{x},{y},0.1,1.0,0.5")
    path = folder / "run.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def _annotations(folder: Path) -> Path:
    rows = []
    for index in range(COUNT):
        for number, (x, y) in enumerate(_places(index)):
            low = [round(100 * value) + 300 for value in (x, y)]
            rows.append(f'{number} {low[0]} {low[1]} {low[0] + 9} {low[1] + 9} {index} 0 0 0 "Biker"')
    path = folder / "annotations.txt"
    path.write_text("\n".join(rows) + "\n")
    return path


def _scenario(folder: Path) -> Path:
    cars = []
    for number in (1, 2):
        states = []
        for index in range(COUNT):
            x, y = _places(index)[number - 1]
            tag = "state" if index else "initialState"
            states.append(
                f"<{tag}><position><point><x>{x}</x><y>{y}</y></point></position><orientation><exact>0</exact>"
                f"</orientation><time><exact>{index}</exact></time></{tag}>"
            )
        shape = "<shape><rectangle><length>1</length><width>1</width></rectangle></shape>"
        path_of = f"<trajectory>{''.join(states[1:])}</trajectory>"
        cars.append(
            f'<dynamicObstacle id="{number}"><type>car</type>{shape}{states[0]}{path_of}</dynamicObstacle>'
        )
    path = folder / "scenario.xml"
    path.write_text(f'<?xml version="1.0"?>\n<commonRoad timeStepSize="0.1">{"".join(cars)}</commonRoad>\n')
    return path


def _recorded(folder: Path) -> Path:
    (folder / "s.spatial").write_text(SPECIFICATION)
    tracks = _tracks(folder)
    said_by(
        ["record", "tracks", str(tracks), "--spec", str(folder / "s.spatial"), "-o", str(folder / "run.mcap")]
    )
    return folder / "run.mcap"


def _annotated(folder: Path) -> Path:
    (folder / "m.yaml").write_text(MAPPING)
    drive = _ros1(folder)
    (folder / "s.spatial").write_text(SPECIFICATION)
    options = ["--mapping", str(folder / "m.yaml"), "--spec", str(folder / "s.spatial")]
    said_by(["replay", str(drive), *options, "-o", str(folder / "annotated.mcap")])
    return folder / "annotated.mcap"


def _poses(make: Callable[[float, float, int], Any]) -> list[Any]:
    from bags.bag_files import POSE, START_NS, TEXT, Sent, text

    sent = []
    for index in range(COUNT):
        time_ns = START_NS + index * 10**8
        for late, (name, (x, y)) in enumerate(zip("ab", _places(index), strict=True)):
            sent.append(Sent(f"/{name}/pose", POSE, time_ns + late, make(x, y, time_ns)))
        sent.append(Sent("/words", TEXT, time_ns + 2, text(f"number {index}")))
    return sent


def _pose(store: Any) -> Callable[[float, float, int], Any]:
    def make(x: float, y: float, time_ns: int) -> Any:
        types = store.types
        stamp = types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
        fields = types["std_msgs/msg/Header"].__dataclass_fields__
        more = {"seq": 0} if "seq" in fields else {}
        header = types["std_msgs/msg/Header"](**more, stamp=stamp, frame_id="map")
        place = types["geometry_msgs/msg/Point"](x, y, 0.0)
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        return types["geometry_msgs/msg/PoseStamped"](header, types["geometry_msgs/msg/Pose"](place, turn))

    return make


def _ros1(folder: Path, compression: Any = "none") -> Path:
    from bags.bag_files import ROS1, write_ros1

    return write_ros1(folder / "drive.bag", _poses(_pose(ROS1)), compression=compression, chunk_bytes=4_000)


def _ros2(folder: Path, storage: Any, compression: Any = "none") -> Path:
    from bags.bag_files import ROS2, write_ros2

    return write_ros2(folder / "drive", _poses(_pose(ROS2)), storage=storage, compression=compression)


def _json_mcap(folder: Path) -> Path:
    from bags.bag_files import START_NS, write_json_mcap

    messages = [
        (f"/{name}/pose", START_NS + index * 10**8 + late, {"x": x, "y": y})
        for index in range(COUNT)
        for late, (name, (x, y)) in enumerate(zip("ab", _places(index), strict=True))
    ]
    return write_json_mcap(folder / "drive.mcap", messages, chunk_bytes=4_000)


FORMATS = {
    "ours": Format(_recorded, is_checked=True),
    "annotated": Format(_annotated, is_checked=True),
    "mcap json": Format(_json_mcap, _JSON_MAPPING, is_checked=True),
    "mcap cdr": Format(lambda folder: _ros2(folder, "mcap"), MAPPING),
    "db3": Format(lambda folder: _ros2(folder, "sqlite3"), MAPPING),
    "db3 in zstd": Format(lambda folder: _ros2(folder, "sqlite3", "message"), MAPPING),
    "ros1": Format(_ros1, MAPPING),
    "ros1 bz2": Format(lambda folder: _ros1(folder, "bz2"), MAPPING),
    "ros1 lz4": Format(lambda folder: _ros1(folder, "lz4"), MAPPING),
    "tracks": Format(_tracks, is_text=True, recovers=False),
    "tracks in gzip": Format(_packed_tracks, recovers=False),
    "csv": Format(_csv, is_text=True, recovers=False),
    "drone": Format(_annotations, is_text=True, recovers=False, names=("0", "1")),
    "commonroad": Format(_scenario, is_text=True, recovers=False, names=("1", "2")),
}
