"""Several cameras of one scene: what is hidden from one is seen from another."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception.filmed import (
    BLOCKS,
    FROM_THE_OTHER,
    FROM_THE_SIDE,
    PERIOD_NS,
    REFERENCES,
    TABLE,
    picture,
    plates,
)
from spatial_replay import UsageError, read_trace
from spatial_replay.cli import run
from spatial_replay.perception import Frame, TagObserver, observe_cameras, parse_tags
from spatial_replay.perception.observer import simultaneous
from spatial_replay.perception.video import VideoWriter

for each in ("av", "cv2"):
    pytest.importorskip(each)

RED, BLUE = 0, 1
PLACES = {RED: (0.4, -0.06, 0.3), BLUE: (0.5, 0.06, 0.0)}
COUNT = 6


def frames(pose: np.ndarray, shown: tuple[int, ...], count: int = COUNT) -> Iterator[Frame]:
    """Yield what a camera sees of some of the blocks."""
    scene = plates(parse_tags(TABLE), {number: PLACES[number] for number in shown})
    for index in range(count):
        yield Frame(index * PERIOD_NS, picture(scene, seed=index, pose=pose))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cameras")
    (folder / "tags.yaml").write_text(f"{TABLE}fastest: 0.1\n")
    (folder / "apart.spatial").write_text("spec apart = G (red dist blue >= 0.04)\n")
    # red is hidden from the left camera, blue from the right one, which ends earlier
    for name, pose, shown, count in (
        ("left.mp4", FROM_THE_SIDE, (BLUE,), COUNT),
        ("right.mp4", FROM_THE_OTHER, (RED,), COUNT - 3),
    ):
        with VideoWriter(folder / name, 25) as writer:
            for frame in frames(pose, shown, count):
                writer.write(frame)
    return folder


def test_what_is_hidden_from_one_camera_is_seen_by_the_other(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left, right, output = folder / "left.mp4", folder / "right.mp4", folder / "seen.mcap"
    options = ["--tags", f"{folder}/tags.yaml", "--spec", f"{folder}/apart.spatial", "-o", f"{output}"]
    assert run(["record", "video", f"{left}", f"{right}", *options, "--hold-hidden", "1s"]) == 0
    said = capsys.readouterr()
    assert "reference tags fit within" in said.out
    assert "in right.mp4" in said.out
    assert "right.mp4 ends after 0.080 s, and the run after 0.200 s" in said.err
    trace = read_trace(output)
    assert len(trace) == COUNT
    for name, number in (("red", RED), ("blue", BLUE)):
        rows = trace.rows[:, list(trace.names).index(name)]
        assert (rows >= 0).all()
        centres = trace.footprints.select(rows).vertices.reshape(COUNT, 4, 2).mean(axis=1)
        off = np.linalg.norm(centres - np.array(PLACES[number][:2]), axis=1)
        assert (off <= trace.uncertainty[rows]).all()
    assert run(["verify", f"{output}"]) == 0
    assert run(["info", f"{output}"]) == 0
    shown = capsys.readouterr().out
    for topic, count in (
        ("/camera/video", COUNT),
        ("/camera2/video", COUNT - 3),
        ("/camera2/annotations", COUNT - 3),
    ):
        line = next(line for line in shown.splitlines() if line.split()[:1] == [topic])
        assert f"{count} messages" in line
    # as topics of one log, they say the same
    again = folder / "again.mcap"
    topics = ["--topic", "/camera/video", "--topic", "/camera2/video"]
    assert (
        run(["record", "video", f"{output}", *topics, *options[:-1], f"{again}", "--hold-hidden", "1s"]) == 0
    )
    assert read_trace(again).times_ns.tolist() == trace.times_ns.tolist()
    assert read_trace(again).names == trace.names


def test_when_one_video_breaks_off_within_a_frame_the_other_goes_on(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import av

    broken, output = folder / "broken.ts", folder / "goes_on.mcap"
    with VideoWriter(broken, 25) as writer:
        for frame in frames(FROM_THE_OTHER, (RED,), COUNT - 2):
            writer.write(frame)
    with av.open(str(broken)) as container:
        last = [packet for packet in container.demux(video=0) if packet.size][-1]
        cut = last.pos + last.size // 2
    broken.write_bytes(broken.read_bytes()[:cut])
    given = [f"{folder}/left.mp4", f"{broken}", "--tags", f"{folder}/tags.yaml", "-o", f"{output}"]
    assert run(["record", "video", *given]) == 3
    said = capsys.readouterr().err
    assert "broken.ts breaks off after 0.080 s, within a frame" in said
    assert "broken.ts ends after 0.080 s, and the run after 0.200 s: what only it showed is hidden" in said
    # whole is what was recorded: all of the left camera, and three frames of the right one
    assert run(["verify", f"{output}"]) == 0
    trace = read_trace(output)
    red, blue = ((trace.rows[:, list(trace.names).index(name)] >= 0).tolist() for name in ("red", "blue"))
    assert (red, blue) == ([True] * 3 + [False] * 3, [True] * COUNT)
    assert (
        run(["record", "video", f"{output}", "--topic", "/camera2/video", *given[2:-1], f"{folder}/y.mcap"])
        == 0
    )
    assert len(read_trace(folder / "y.mcap")) == 3


def test_a_layout_shows_each_camera(folder: Path) -> None:
    from mcap.reader import make_reader

    output = folder / "shown.mcap"
    videos = [f"{folder}/left.mp4", f"{folder}/right.mp4"]
    assert run(["record", "video", *videos, "--tags", f"{folder}/tags.yaml", "-o", f"{output}"]) == 0
    with output.open("rb") as stream:
        (layout,) = [each for each in make_reader(stream).iter_attachments() if each.name == "layout.json"]
    text = json.dumps(json.loads(layout.data))
    for topic in ("/camera/video", "/camera/annotations", "/camera2/video", "/camera2/annotations"):
        assert f'"{topic}"' in text


def test_an_object_that_two_cameras_see_is_more_certain() -> None:
    tags = parse_tags(TABLE)
    views = [list(frames(pose, (RED, BLUE), 1)) for pose in (FROM_THE_SIDE, FROM_THE_OTHER)]
    alone = [next(iter(observe_cameras([view], tags))).sample for view in views]
    (both,) = observe_cameras(views, tags)
    for name in ("red", "blue"):
        stated = both.sample.objects[name].uncertainty
        assert stated < min(each.objects[name].uncertainty for each in alone)
    # what comes later is as much less certain as it may have moved, and does no harm
    late = [views[0], [Frame(each.time_ns + 10**7, each.image) for each in views[1]]]
    (shifted,) = [TagObserver(tags, cameras=["left", "right"]).observe(*[view[0] for view in late])]
    for name in ("red", "blue"):
        assert shifted.sample.objects[name].uncertainty == alone[0].objects[name].uncertainty


def test_cameras_that_differ_are_named_in_the_tags_file(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose = "pose: {position: [0.9, 0.04, 0.78], look_at: [0.49, 0, 0]}"
    lens = "size: [480, 360], focal: [640, 640]"
    named = f"cameras: {{left.mp4: {{{lens}, {pose}}}, 2: {{{lens}}}}}"
    tags = parse_tags(f"{BLOCKS}\n{REFERENCES}\n{named}\n", "tags.yaml")
    assert tags.of_camera("left.mp4", 1, count=2).pose is not None
    assert tags.of_camera("right.mp4", 2, count=2).pose is None
    with pytest.raises(
        UsageError, match=r"tags\.yaml has no camera top\.mp4; its cameras are left\.mp4, 2; "
    ):
        tags.of_camera("top.mp4", 3, count=3)
    one = parse_tags(f"{BLOCKS}\n{REFERENCES}\ncamera: {{{lens}, {pose}}}\n", "tags.yaml")
    with pytest.raises(UsageError, match=r"tags\.yaml gives one pose for 2 cameras; write cameras"):
        TagObserver(one, cameras=["left.mp4", "right.mp4"])
    # through the command line, without reference tags, by name and by number, and a third one
    (folder / "third.mp4").write_bytes((folder / "right.mp4").read_bytes())
    other = "pose: {position: [0.45, 0.42, 0.78], look_at: [0.47, 0, 0]}"
    two = f"{{left.mp4: {{{lens}, {pose}}}, 2: {{{lens}, {other}}}"
    for named, more in ((f"{two}}}", []), (f"{two}, third.mp4: {{{lens}, {other}}}}}", ["third.mp4"])):
        (folder / "posed.yaml").write_text(f"{BLOCKS}\ncameras: {named}\n")
        output, videos = (
            folder / "posed.mcap",
            [f"{folder}/{each}" for each in ("left.mp4", "right.mp4", *more)],
        )
        assert run(["record", "video", *videos, "--tags", f"{folder}/posed.yaml", "-o", f"{output}"]) == 0
        trace = read_trace(output)
        for name, number in (("red", RED), ("blue", BLUE)):
            row = trace.rows[:1, list(trace.names).index(name)]
            centre = trace.footprints.select(row).vertices.mean(axis=0)
            assert np.linalg.norm(centre - PLACES[number][:2]) <= trace.uncertainty[row[0]] < 0.005
        assert run(["info", f"{output}"]) == 0
        assert ("/camera3/video" in capsys.readouterr().out) == bool(more)
    # poses that are swapped are no secret
    swapped = f"{{left.mp4: {{{lens}, {other}}}, right.mp4: {{{lens}, {pose}}}}}"
    views = [list(frames(each, (RED, BLUE), 1)) for each in (FROM_THE_SIDE, FROM_THE_OTHER)]
    observer = TagObserver(parse_tags(f"{BLOCKS}\ncameras: {swapped}\n"), cameras=["left.mp4", "right.mp4"])
    observer.observe(*[view[0] for view in views])
    assert "red: its tags contradict each other in 1 frame, by up to 0." in " ".join(observer.remarks())
    (folder / "posed.yaml").write_text(
        f"{BLOCKS}\ncameras: {{left.mp4: {{{lens}, {pose}}}, 2: {{{lens}}}}}\n"
    )
    assert run(["record", "video", *videos[:2], "--tags", f"{folder}/posed.yaml", "-o", f"{output}"]) == 2
    assert "or the pose of each camera; 2 has none" in capsys.readouterr().err
    video = [
        f"{folder}/left.mp4",
        f"{folder}/right.mp4",
        "--tags",
        f"{folder}/tags.yaml",
        "-o",
        f"{folder}/x.mcap",
    ]
    assert run(["record", "video", *video, "--offset", "middle.mp4=10ms"]) == 2
    assert "'middle.mp4' is no camera; write the number and a time: 1 (left.mp4), 2 (right.mp4)" in (
        capsys.readouterr().err
    )
    assert not (folder / "x.mcap").exists()


@given(
    st.lists(st.sets(st.integers(0, 300), max_size=6).map(sorted), min_size=1, max_size=3),
    st.tuples(*[st.integers(0, 50)] * 3),
)
def test_each_frame_is_in_one_sample_with_those_of_its_time(
    cameras: list[list[int]], offsets: tuple[int, ...]
) -> None:
    image = np.zeros((1, 1), np.uint8)
    films = [[Frame(time, image) for time in times] for times in cameras]
    together = list(simultaneous(films, offsets[: len(films)]))
    for place, times in enumerate(cameras):
        taken = [frames[place].time_ns for frames in together if frames[place] is not None]
        assert taken == [time + offsets[place] for time in times]
    spans = [[frame.time_ns for frame in frames if frame is not None] for frames in together]
    assert all(spans)
    for earlier, later in pairwise(spans):
        assert max(earlier) < min(later)
    gaps = [b - a for times in cameras for a, b in pairwise(times)]
    assert all(max(span) - min(span) <= max(gaps, default=0) / 2 for span in spans)
