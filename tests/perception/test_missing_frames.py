"""Videos with frames that are missing or damaged: what was drawn onto them is never believed."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from perception.filmed import PERIOD_NS, approaching, film, write_approach
from spatial_replay import read_trace
from spatial_replay.cli import run
from spatial_replay.perception import open_frames

COUNT, KEYS = 16, 8
NAMES = {"red", "blue"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the table in two codecs, a key frame every eight frames, and a log of the first."""
    folder = tmp_path_factory.mktemp("missing")
    write_approach(folder, 2)
    frames = list(film(approaching(COUNT), COUNT))
    plain = f"keyint={KEYS}:min-keyint={KEYS}:scenecut=0:bframes=0"
    for name in ("h264.mkv", "hevc.mkv", "reordered.mp4", "reordered.avi"):
        codec, form = ("libx265", "x265-params") if "hevc" in name else ("libx264", "x264-params")
        parameters = plain.replace("bframes=0", "bframes=2:b-adapt=0") if "reordered" in name else plain
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=25)
            height, width = frames[0].image.shape[:2]
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.options = {"crf": "18", "preset": "ultrafast", form: f"{parameters}:log-level=none"}
            for frame in frames:
                image = frame.image if frame.image.ndim == 3 else np.repeat(frame.image[..., None], 3, 2)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
            container.mux(stream.encode(None))
    record(folder, folder / "h264.mkv", folder / "h264.mcap", "--keep-video", "copy")
    return folder


def record(folder: Path, source: Path, output: Path, *more: str) -> int:
    arguments = ["--tags", f"{folder}/tags.yaml", *more, "-o", f"{output}"]
    return run(["record", "video", f"{source}", *arguments])


def without(source: Path, output: Path, gone: set[int], damaged: int | None = None) -> Path:
    """Write a video or a log without some of its frames, and one of them with other bytes in its middle."""
    with av.open(str(source)) as video, av.open(str(output), "w") as container:
        stream = container.add_stream_from_template(video.streams.video[0])
        for index, packet in enumerate(video.demux(video=0)):
            if packet.dts is None or index in gone:
                continue
            if index == damaged:
                content = bytearray(bytes(packet))
                at = len(content) // 2
                content[at : at + 60] = np.random.default_rng(1).bytes(60)
                changed = av.Packet(bytes(content))
                changed.pts, changed.dts, changed.time_base = packet.pts, packet.dts, packet.time_base
                packet = changed
            packet.stream = stream
            container.mux(packet)
    return output


def log_without(
    source: Path, output: Path, gone: set[int], damaged: int | None = None, undecodable: int | None = None
) -> Path:
    """As `without`, of the messages of a log's video."""
    from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo

    with source.open("rb") as stream, output.open("wb") as to:
        writer = Writer(to)
        writer.start()
        channel = None
        messages = make_reader(stream).iter_messages(topics=["/camera/video"])
        for index, (schema, own, message) in enumerate(messages):
            if channel is None:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channel = writer.register_channel(own.topic, own.message_encoding, known)
            data = message.data
            if index == damaged:
                value = CompressedVideo.FromString(data)
                at = len(value.data) // 2
                value.data = value.data[:at] + np.random.default_rng(1).bytes(60) + value.data[at + 60 :]
                data = value.SerializeToString()
            if index == undecodable:
                value = CompressedVideo.FromString(data)
                value.data = b"\0\0\0\1\x01"
                data = value.SerializeToString()
            if index not in gone:
                writer.add_message(channel, message.log_time, data, message.publish_time)
        writer.finish()
    return output


def seen(log: Path) -> dict[int, set[str]]:
    """Return which objects are known in each frame."""
    trace = read_trace(log)
    return {sample.time_ns // PERIOD_NS: set(sample.objects) for sample in trace.samples()}


@pytest.mark.parametrize("name", ["h264.mkv", "hevc.mkv", "h264.mcap"])
def test_after_a_missing_frame_nothing_is_believed_until_the_next_key_frame(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = log_without if name.endswith("mcap") else without
    lossy = cut(folder / name, folder / f"lossy-{name}", {3, 4})
    assert record(folder, lossy, folder / "out.mcap") == 3
    assert "missing or damaged after 0.200 s; 3 frames, up to the next key frame, left out" in (
        capsys.readouterr().err.replace("\n", " ")
    )
    shown = seen(folder / "out.mcap")
    assert sorted(shown) == [each for each in range(COUNT) if each not in (3, 4)]
    assert [each for each in shown if shown[each] != NAMES] == [5, 6, 7]
    assert not any(shown[each] for each in (5, 6, 7))


@pytest.mark.parametrize("name", ["h264.mkv", "h264.mcap"])
def test_after_a_damaged_frame_nothing_is_believed_until_the_next_key_frame(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = log_without if name.endswith("mcap") else without
    lossy = cut(folder / name, folder / f"damaged-{name}", set(), 3)
    assert record(folder, lossy, folder / "out.mcap") == 3
    assert "frames are missing or damaged after 0.120 s" in capsys.readouterr().err
    shown = seen(folder / "out.mcap")
    assert [each for each in range(COUNT) if shown.get(each, set()) != NAMES] == [3, 4, 5, 6, 7]


def test_frames_shown_before_a_missing_one_but_decoded_after_it_are_not_believed(folder: Path) -> None:
    with av.open(str(folder / "reordered.mp4")) as video:
        order = [round(packet.pts * packet.time_base * 25) for packet in video.demux(video=0) if packet.size]
    gone = next(place for place, number in enumerate(order) if number > place and place > 1)
    lossy = without(folder / "reordered.mp4", folder / "lossy.mp4", {gone})
    assert record(folder, lossy, folder / "out.mcap") == 3
    shown = seen(folder / "out.mcap")
    untrue = {number for number in order[gone:] if number < KEYS}
    assert {number for number in shown if shown[number] != NAMES} == untrue - {order[gone]}


def test_an_avi_with_b_frames_has_the_frames_and_times_of_the_same_film_as_mp4(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("reordered.mp4", "reordered.avi"):
        assert record(folder, folder / name, folder / f"{name}.mcap") == 0
    assert "left out" not in capsys.readouterr().err
    assert read_trace(folder / "reordered.avi.mcap") == read_trace(folder / "reordered.mp4.mcap")
    times_ns = [frame.time_ns for frame in open_frames(folder / "reordered.avi")]
    assert times_ns == [number * PERIOD_NS for number in range(COUNT)]


def test_a_lossy_avi_with_b_frames_has_its_own_times_again_from_the_next_key_frame_on(folder: Path) -> None:
    whole = {frame.time_ns: frame.image for frame in open_frames(folder / "reordered.avi")}
    frames = open_frames(without(folder / "reordered.avi", folder / "lossy.avi", {1}))
    shown = {frame.time_ns: frame.image for frame in frames if frame.image.any()}
    assert len(frames.faults) == 1
    assert {number * PERIOD_NS for number in range(KEYS, COUNT)} <= set(shown)
    assert all(np.array_equal(image, whole[time_ns]) for time_ns, image in shown.items())


def test_a_film_whose_stamps_go_back_is_refused_and_takes_a_rate_without_a_warning(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    swapped = folder / "swapped.mkv"
    with av.open(str(folder / "reordered.mp4")) as video, av.open(str(swapped), "w") as container:
        stream = container.add_stream_from_template(video.streams.video[0])
        for index, packet in enumerate(packet for packet in video.demux(video=0) if packet.size):
            packet.pts = packet.dts = round(index / 25 / packet.time_base)
            packet.stream = stream
            container.mux(packet)
    assert record(folder, swapped, folder / "out.mcap") == 3
    assert "swapped.mkv has time stamps that go back: frame" in capsys.readouterr().err
    assert record(folder, swapped, folder / "out.mcap", "--rate", "25") == 0
    assert "swapped.mkv" not in capsys.readouterr().err
    assert read_trace(folder / "out.mcap").times_ns.tolist() == [
        PERIOD_NS * number for number in range(COUNT)
    ]


def test_each_frame_of_a_lossy_topic_has_its_own_stamp_and_comes_out(folder: Path) -> None:
    whole = {frame.time_ns: frame.image for frame in open_frames(folder / "h264.mcap")}
    lossy = log_without(folder / "h264.mcap", folder / "lossy.mcap", {3, 11, 13})
    frames = open_frames(lossy)
    shown = {frame.time_ns: frame.image for frame in frames}
    assert len(frames.faults) == 1
    assert len(shown) == COUNT - 3
    for time_ns, image in shown.items():
        assert not image.any() or np.array_equal(image, whole[time_ns])
    assert sum(image.any() for image in shown.values()) == 6


def test_a_message_that_cannot_be_decoded_is_a_sample_without_objects_like_those_after_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lossy = log_without(folder / "h264.mcap", folder / "lossy.mcap", set(), undecodable=3)
    assert record(folder, lossy, folder / "out.mcap") == 3
    assert "after 0.120 s: a frame cannot be decoded" in capsys.readouterr().err
    shown = seen(folder / "out.mcap")
    assert sorted(shown) == list(range(COUNT))
    assert [each for each in shown if not shown[each]] == [3, 4, 5, 6, 7]
