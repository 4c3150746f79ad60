"""What a viewer needs of every recording that ships with the project, and of its replays."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from google.protobuf.message import Message
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from annotate.layouts import layout_of, panels, paths_of
from annotate.message_paths import newest, split, values
from spatial_replay.cli import run as run_in_process

RECORDINGS = Path(__file__).resolve().parent.parent / "recordings"
LOGS = sorted([*RECORDINGS.glob("*.mcap"), *RECORDINGS.glob("*.jsonl")])
CASES = [
    (log.name, specification)
    for log in LOGS
    for specification in (None, *sorted(each.name for each in RECORDINGS.glob(f"{log.stem}*.spatial")))
]
SECOND_NS = 1_000_000_000
WIDTHS = {
    PackedElementField.UINT8: 1,
    PackedElementField.INT8: 1,
    PackedElementField.UINT16: 2,
    PackedElementField.INT16: 2,
    PackedElementField.UINT32: 4,
    PackedElementField.INT32: 4,
    PackedElementField.FLOAT32: 4,
    PackedElementField.FLOAT64: 8,
}


class LogMessage(NamedTuple):
    """A decoded message of a log."""

    topic: str
    schema: str
    time_ns: int
    message: Any


class Log(NamedTuple):
    """A log that a viewer opens, and its messages."""

    path: Path
    messages: tuple[LogMessage, ...]

    def of(self, schema: str) -> list[LogMessage]:
        return [each for each in self.messages if each.schema == schema]

    def on(self, topic: str) -> list[LogMessage]:
        return [each for each in self.messages if each.topic == topic]


@pytest.fixture(scope="module", params=CASES, ids=[f"{log}-{spec or 'as it is'}" for log, spec in CASES])
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Log:
    """A recording as it is or, of track files, recorded; or a replay of that with a specification."""
    name, specification = request.param
    folder = tmp_path_factory.mktemp("viewing")
    path = RECORDINGS / name
    if path.suffix != ".mcap":
        recorded = folder / "recorded.mcap"
        assert run_in_process(["record", "tracks", str(path), "-o", str(recorded)]) == 0
        path = recorded
    if specification is not None:
        output = folder / "annotated.mcap"
        command = ["replay", str(path), "--spec", str(RECORDINGS / specification), "-o", str(output)]
        assert run_in_process(command) in (0, 1)
        path = output
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        messages = tuple(
            LogMessage(channel.topic, schema.name, message.log_time, decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages()
            if schema is not None
        )
    return Log(path, messages)


@cache
def has_frames(descriptor: Any) -> bool:
    """Whether messages of a type name frames, themselves or in what they hold; none holds its own type."""
    return any(
        field.name.endswith("frame_id") or (field.message_type is not None and has_frames(field.message_type))
        for field in descriptor.fields
    )


def frames(message: Message) -> Iterator[str]:
    """Every frame that a message names."""
    for field, value in message.ListFields():
        if field.name.endswith("frame_id"):
            yield value
        elif field.message_type is not None and has_frames(field.message_type):
            for inner in [value] if isinstance(value, Message) else value:
                yield from frames(inner)


def points(entity: Any) -> np.ndarray:
    """The corners (n, 3) of an entity's lines and faces."""
    corners = [
        (point.x, point.y, point.z + primitive.pose.position.z)
        for primitive in [*entity.lines, *entity.triangles]
        for point in primitive.points
    ]
    return np.array(corners)


def test_every_message_path_of_the_layout_has_values(log):
    layout = layout_of(log.path)
    assert panels(layout) == set(layout["configById"])
    for path in paths_of(layout["configById"]):
        assert values(log.path, path), path


def test_panels_of_one_message_show_the_newest_one(log):
    for identifier, config in layout_of(log.path)["configById"].items():
        if identifier.startswith(("Table!", "RawMessages!")):
            # they show one value, so that a path to each item of a list shows the first one only
            assert len(newest(log.path, config["topicPath"])) == 1, config


def test_every_frame_is_the_displayed_one_or_has_a_transform(log):
    fixed = layout_of(log.path)["configById"]["3D!scene"]["followTf"]
    transforms = [each.message for each in log.of("foxglove.FrameTransform")]
    known = {
        fixed,
        *(each.child_frame_id for each in transforms),
        *(each.parent_frame_id for each in transforms),
    }
    named = {frame for each in log.messages for frame in frames(each.message)}
    assert named
    assert named <= known


def test_the_cells_of_every_grid_match_its_strides(log):
    for _, _, _, grid in log.of("foxglove.Grid"):
        ends = {field.name: (field.offset, field.offset + WIDTHS[field.type]) for field in grid.fields}
        assert "robustness" in ends
        assert max(end for _, end in ends.values()) <= grid.cell_stride
        assert sorted(begin for begin, _ in ends.values())[1:] == sorted(end for _, end in ends.values())[:-1]
        assert grid.row_stride == grid.cell_stride * grid.column_count > 0
        assert len(grid.data) % grid.row_stride == 0
        assert len(grid.data) > 0
        assert grid.cell_size.x > 0
        assert grid.cell_size.y > 0


def test_blocked_cells_are_transparent_and_better_ones_less_red_and_more_blue(log):
    for _, _, _, grid in log.of("foxglove.Grid"):
        cell = np.dtype(
            {
                "names": [field.name for field in grid.fields],
                "formats": ["u1" if field.type == field.UINT8 else "<f4" for field in grid.fields],
                "offsets": [field.offset for field in grid.fields],
                "itemsize": grid.cell_stride,
            }
        )
        cells = np.frombuffer(grid.data, cell)
        assert np.array_equal(cells["alpha"] == 0, np.isnan(cells["robustness"]))
        open_cells = np.sort(cells[cells["alpha"] > 0], order="robustness")
        redness = open_cells["red"].astype(int) - open_cells["blue"]
        assert (np.diff(redness) <= 1).all()  # each colour is rounded to a whole number
        assert redness[-1] < redness[0] or open_cells["robustness"][-1] == open_cells["robustness"][0]


def test_what_the_layout_shows_is_at_most_60_hz_and_robustness_has_every_sample(log):
    for topic in {split(path)[0] for path in paths_of(layout_of(log.path)["configById"])}:
        times = np.array([each.time_ns for each in log.on(topic)])
        assert (np.searchsorted(times, times + SECOND_NS) - np.arange(len(times))).max() <= 60
    samples = [each.time_ns for each in log.on("/spatial/objects")]
    reported: dict[tuple[str, str], list[int]] = {}
    for each in log.on("/spatial/robustness"):
        # logs of earlier versions have no such message
        if getattr(each.message, "final", False):
            assert each.time_ns >= samples[-1]
            continue
        reported.setdefault((each.message.specification, each.message.object), []).append(each.time_ns)
    assert all(times == samples for times in reported.values())


def test_a_viewer_shows_exactly_the_observed_objects(log):
    seen = {
        each.time_ns: {f"object/{tracked.name}" for tracked in each.message.objects}
        for each in log.on("/spatial/objects")
    }
    drawn: set[str] = set()
    regions = None
    for each in log.on("/spatial/scene"):
        identifiers = [entity.id for entity in each.message.entities]
        assert len(set(identifiers)) == len(identifiers)
        of_regions = {identifier for identifier in identifiers if identifier.startswith("region/")}
        regions = of_regions if regions is None else regions
        assert of_regions == regions
        assert set(identifiers) - {"witness", "verdict"} == seen[each.time_ns] | regions
        drawn = (drawn - {deletion.id for deletion in each.message.deletions}) | set(identifiers)
        assert drawn == set(identifiers)


def test_the_camera_shows_every_object(log):
    camera = layout_of(log.path)["configById"]["3D!scene"]["cameraState"]
    corners = np.concatenate(
        [
            points(entity)[:, :2]
            for each in log.on("/spatial/scene")
            for entity in each.message.entities
            if entity.id.startswith("object/")
        ]
    )
    # a panel may be narrower than it is high, by a quarter
    assert (np.abs(corners - camera["targetOffset"][:2]) <= 0.75 * camera["distance"] / 2).all()
