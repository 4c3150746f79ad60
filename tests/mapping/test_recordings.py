"""Public recordings: known figures of their mapped traces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spatial_replay import Trace
from spatial_replay.bags.open import open_messages
from spatial_replay.geometry.arrays import Floats
from spatial_replay.mapping.assemble import Assembler
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import ReadingPlan

TURTLES = ("two_turtles.bag", "two_turtles_lz4.bag", "two_turtles_mcap", "two_turtles_sqlite3")
POSES = """
sample: {topic: /turtle2/pose}
topics:
  /turtle1/pose: {shape: {disc: 0.5}}
  /turtle2/pose: {shape: {disc: 0.5}}
"""
FRAMES = """
fixed_frame: world
topics:
  /tf: {shape: {disc: 0.5}}
"""


def mapped(path: Path, text: str, *remarks: str) -> Trace:
    reader = open_messages(path)
    plan = ReadingPlan.of(parse_mapping(text), reader.topics())
    assembler = Assembler(plan, reader.decoder, name=path.name)
    trace = Trace.concatenate([assembler.add(list(reader.iter_messages(plan.topics))), assembler.finish()])
    assert (assembler.take_faults(), assembler.take_doubts()) == ((), ())
    assert [str(remark).partition(",")[0] for remark in assembler.take_remarks()] == list(remarks)
    return trace


def centres(trace: Trace, name: str) -> Floats:
    """Return the one vertex (T, 2) of each footprint; NaN where the object is unknown."""
    rows = trace.rows[:, trace.names.index(name)]
    found = np.full((len(trace), 2), np.nan)
    found[rows >= 0] = trace.footprints.vertices[trace.footprints.part_start[rows[rows >= 0]]]
    return found


@pytest.mark.parametrize("name", TURTLES)
def test_the_distance_of_two_turtles_is_the_same_in_all_containers(data_folder: Path, name: str) -> None:
    trace = mapped(data_folder / "bags" / name, POSES)
    distance = np.linalg.norm(centres(trace, "turtle1") - centres(trace, "turtle2"), axis=1)
    assert len(trace) == 1344
    figures = distance.min(), distance.max(), distance[-1]
    assert [round(float(figure), 4) for figure in figures] == [0.0721, 3.8663, 0.2744]
    assert trace == mapped(data_folder / "bags" / TURTLES[0], POSES)


def test_poses_and_transforms_agree(data_folder: Path) -> None:
    poses = mapped(data_folder / "bags" / TURTLES[0], POSES)
    frames = mapped(data_folder / "bags" / TURTLES[0], FRAMES)
    for name in ("turtle1", "turtle2"):
        at = centres(poses, name)
        assert np.allclose(centres(frames, name)[-1], at[-1], atol=1e-6)
        assert np.allclose(np.nanmax(centres(frames, name), axis=0), np.nanmax(at, axis=0), atol=1e-6)


def test_five_tags_are_sampled_by_either_clock(data_folder: Path) -> None:
    text = (
        "topics: {/detector/tags: {objects: 'apriltags[*]', name: 'tag{id}', polygon: corners, class: tag}}"
    )
    by_log = mapped(data_folder / "bags/apriltags_table.bag", text)
    by_stamp = mapped(data_folder / "bags/apriltags_table.bag", f"clock: header\n{text}")
    assert by_log.names == tuple(f"tag{number}" for number in range(5))
    assert len(by_log) == len(by_stamp) == 297
    assert (by_stamp.times_ns[0], by_stamp.times_ns[-1]) == (1560889276319019864, 1560889305917852553)
    assert np.array_equal(by_log.rows, by_stamp.rows)
    assert set(np.diff(by_log.footprints.vertex_start).tolist()) == {4}


def test_a_pose_stamped_topic_makes_one_object(data_folder: Path) -> None:
    remark = "pose_db3: /pose: its quaternions have the length 13.19"
    trace = mapped(data_folder / "bags/pose_db3", "topics: {/pose: {}}", remark)
    assert (len(trace), trace.names) == (1565, ("pose",))


def test_vehicles_appear_in_their_known_numbers_of_samples(data_folder: Path) -> None:
    text = """
topics:
  ground_truth:
    objects: "moving_object[*]"
    name: "vehicle{id}"
    class: vehicle
    position: base.position
    yaw: base.orientation.yaw
    shape: {box: [base.dimension.length, base.dimension.width, base.dimension.height]}
"""
    trace = mapped(data_folder / "osi/osi_centerline_example.mcap", text)
    seen = (trace.rows >= 0).sum(axis=0).tolist()
    assert (len(trace), len(trace.names)) == (91, 14)
    assert sorted(seen) == [4, 9, 16, 17, 17, 18, 23, 29, 34, 91, 91, 91, 91, 91]
    assert (trace.rows >= -1).all()
    first = trace.observation(int(trace.rows[0, trace.names.index("vehicle192")]))
    assert first.yaw == pytest.approx(-3.1258041858673096)
    assert first.height == pytest.approx((-24.619448 - 1.881176 / 2, -24.619448 + 1.881176 / 2))
