"""`spatial-replay record video`: a video, an image topic or a camera to a log with verdicts."""

from __future__ import annotations

import json
import os
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from mcap.reader import make_reader

from perception.filmed import CAMERA, TABLE, approaching, film, write_approach
from spatial_replay import Monitor, Recorder, load_specification, read_trace, replay_log
from spatial_replay.cli import run
from spatial_replay.perception import Frame

pytest.importorskip("av")
pytest.importorskip("cv2")

COUNT = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a video, its tags file, a specification, and the log of them."""
    folder = tmp_path_factory.mktemp("table")
    write_approach(folder, COUNT)
    arguments = ["--tags", f"{folder}/tags.yaml", "--spec", f"{folder}/apart.spatial"]
    assert run(["record", "video", f"{folder}/table.mp4", *arguments, "-o", f"{folder}/run.mcap"]) == 1
    return folder


def recorded(folder: Path, source: str, *more: str) -> Path:
    output = folder / "other.mcap"
    arguments = ["--tags", f"{folder}/tags.yaml", "--spec", f"{folder}/apart.spatial", *more]
    assert run(["record", "video", f"{folder}/{source}", *arguments, "-o", str(output)]) == 1
    return output


def payloads(log: Path, topic: str) -> list[bytes]:
    with log.open("rb") as stream:
        return [message.data for *_, message in make_reader(stream).iter_messages(topics=[topic])]


def test_verdicts_are_printed_as_they_change(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded(folder, "table.mp4")
    first, second, wrote, fit, end = capsys.readouterr().out.splitlines()
    assert "0.000 s  holds      `apart` holds so far" in first
    assert "violated   `apart` is permanently violated: red is" in second
    assert wrote.endswith("12 samples over 0.440 s")
    assert fit.startswith("reference tags fit within 0.0")
    assert end.startswith("  apart  violated   robustness -0.02")


def test_a_name_that_the_tags_file_lacks_is_said_before_the_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, tags = (f"{folder}/{name}" for name in ("table.mp4", "tags.yaml"))
    wrong = ("--spec", "G (rde dist blue >= 0)", "-o", f"{folder}/wrong.mcap")
    assert run(["record", "video", video, "--tags", tags, *wrong]) == 4
    said = capsys.readouterr().err
    assert "warning: the tags file never has the object 'rde'" in said
    assert "did you mean 'red'?" in said


def test_without_a_calibration_tags_above_the_plane_decide_nothing_and_the_remedy_is_said(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "flat.yaml").write_text(TABLE.replace(CAMERA, ""))
    arguments = ["--tags", f"{folder}/flat.yaml", "--spec", f"{folder}/apart.spatial"]
    assert run(["record", "video", f"{folder}/table.mp4", *arguments, "-o", f"{folder}/flat.mcap"]) == 4
    said = capsys.readouterr().err
    assert "tags on objects are up to 40 mm above the reference tags, and no camera is calibrated" in said
    assert "calibrate the camera (tags calibrate), or fix the reference tags as high" in said
    assert "lifted" not in said


def test_the_log_holds_truth_within_its_uncertainty_and_a_replay_gives_the_same_bytes(folder: Path) -> None:
    trace = read_trace(folder / "run.mcap")
    assert list(trace.names) == ["blue", "red"] or set(trace.names) == {"blue", "red"}
    replayed = replay_log(folder / "run.mcap", output=folder / "again.mcap")
    (result,) = replayed.results
    # at the end they are 0.145 apart less two halves of 50 mm, so 15 mm: 25 mm too close
    assert result.lower <= 0.145 - 0.1 - 0.05 + 0.02 - 0.04 <= result.upper
    for topic in ("/spatial/robustness", "/camera/video", "/camera/annotations"):
        assert payloads(folder / "run.mcap", topic) == payloads(folder / "again.mcap", topic)
    assert run(["verify", f"{folder}/run.mcap"]) == 0


def test_equal_videos_give_equal_bytes(folder: Path) -> None:
    assert recorded(folder, "table.mp4").read_bytes() == (folder / "run.mcap").read_bytes()


def test_the_video_in_the_log_is_what_viewers_demand(folder: Path) -> None:
    from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo

    for log in (folder / "run.mcap", recorded(folder, "table.mp4", "--keep-video", "h264")):
        frames = [CompressedVideo.FromString(each) for each in payloads(log, "/camera/video")]
        assert [each.format for each in frames] == ["h264"] * COUNT
        kinds = [units(each.data) for each in frames]
        # parameter sets before the key frame; one picture a message, none of them a B frame's
        assert {7, 8, 5} <= set(kinds[0])
        assert all(sum(unit in (1, 5) for unit in own) == 1 for own in kinds)
    assert payloads(recorded(folder, "table.mp4", "--keep-video", "none"), "/camera/video") == []


def units(data: bytes) -> list[int]:
    """Return the kinds of the units of an H.264 frame in Annex B form."""
    return [part[0] & 31 for part in data.split(b"\x00\x00\x01")[1:]]


def test_outlines_are_drawn_where_the_objects_are_in_the_colour_of_what_is_asked(folder: Path) -> None:
    from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations

    every = [
        ImageAnnotations.FromString(each) for each in payloads(folder / "run.mcap", "/camera/annotations")
    ]
    assert {each.text for each in every[0].texts} == {"0", "1", "10", "11", "12", "13", "blue", "red"}
    colours = [
        {(round(p.outline_color.r, 2)) for p in each.points if p.thickness > 2}
        for each in (every[0], every[-1])
    ]
    # blue while it holds, vermillion when it is violated
    assert colours == [{0.0}, {0.83}] or colours == [{0.0}, {0.84}]


def test_the_layout_has_a_panel_for_the_picture(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", f"{folder}/run.mcap", "--layout"]) == 0
    mode = json.loads(capsys.readouterr().out)["configById"]["Image!camera"]["imageMode"]
    assert mode["imageTopic"] == "/camera/video"
    assert mode["calibrationTopic"] == "/camera/calibration"
    assert mode["annotations"] == {"/camera/annotations": {"visible": True}}


def test_a_video_in_a_log_is_read_again_and_kept_as_it_came(folder: Path) -> None:
    again = recorded(folder, "run.mcap")
    assert payloads(again, "/camera/video") == payloads(folder / "run.mcap", "/camera/video")
    assert payloads(again, "/spatial/robustness") == payloads(folder / "run.mcap", "/spatial/robustness")


def test_image_topics_of_ros_give_the_samples_of_their_stamps(folder: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from spatial_replay.perception.opencv import encode_jpeg

    store = get_typestore(Stores.ROS2_HUMBLE)
    time, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    raw, compressed = store.types["sensor_msgs/msg/Image"], store.types["sensor_msgs/msg/CompressedImage"]
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        rgb = writer.add_connection("/camera/image", raw.__msgtype__, typestore=store)
        jpeg = writer.add_connection("/camera/jpeg", compressed.__msgtype__, typestore=store)
        for frame in film(approaching(4), 4):
            image = np.repeat(frame.image[..., None], 3, axis=2)
            stamp = header(time(5, frame.time_ns), "camera")
            height, width = frame.image.shape
            message = raw(stamp, height, width, "rgb8", 0, 3 * width, image.ravel())
            # recorded three seconds after it was taken
            writer.write(rgb, 8 * 10**9 + frame.time_ns, store.serialize_cdr(message, raw.__msgtype__))
            data = np.frombuffer(encode_jpeg(image, 1000, 98), np.uint8)
            other = store.serialize_cdr(compressed(stamp, "jpeg", data), compressed.__msgtype__)
            writer.write(jpeg, 8 * 10**9 + frame.time_ns, other)
    tags = f"{folder}/tags.yaml"
    stated = []
    for topic in ("/camera/image", "/camera/jpeg"):
        log = folder / "ros.mcap"
        assert (
            run(["record", "video", f"{folder}/bag", "--topic", topic, "--tags", tags, "-o", str(log)]) == 0
        )
        trace = read_trace(log)
        assert trace.times_ns.tolist() == [5 * 10**9 + 40_000_000 * index for index in range(4)]
        stated.append(trace.footprints.vertices)
        assert len(payloads(log, topic)) == 4
    assert stated[0] == pytest.approx(stated[1], abs=0.003)


def test_image_topics_of_ros_1_are_read(folder: Path) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    time, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    raw = store.types["sensor_msgs/msg/Image"]
    with Writer(folder / "ros1.bag") as writer:
        grey = writer.add_connection("/camera/image_raw", raw.__msgtype__, typestore=store)
        for index, frame in enumerate(film(approaching(3), 3)):
            height, width = frame.image.shape
            stamp = header(index, time(5, frame.time_ns), "camera")
            message = raw(stamp, height, width, "mono8", 0, width, frame.image.ravel())
            data = store.serialize_ros1(message, raw.__msgtype__)
            writer.write(grey, 8 * 10**9 + frame.time_ns, data)
    log, tags = folder / "ros1.mcap", f"{folder}/tags.yaml"
    assert run(["record", "video", f"{folder}/ros1.bag", "--tags", tags, "-o", str(log)]) == 0
    trace = read_trace(log)
    assert trace.times_ns.tolist() == [5 * 10**9 + 40_000_000 * index for index in range(3)]
    assert set(trace.names) == {"blue", "red"}
    assert len(payloads(log, "/camera/image_raw")) == 3


@pytest.mark.parametrize(
    "encoding", ["bayer_rggb8", "bayer_grbg8", "mono16", "big mono16", "yuv422", "yuv422_yuy2"]
)
def test_raw_images_as_sensors_give_them_show_the_same_tags(encoding: str, folder: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from spatial_replay.perception import load_tags, observe_frames, open_frames

    store = get_typestore(Stores.ROS2_HUMBLE)
    raw, time = store.types["sensor_msgs/msg/Image"], store.types["builtin_interfaces/msg/Time"]
    header = store.types["std_msgs/msg/Header"]
    (frame,) = film(approaching(2), 1)
    grey = frame.image
    height, width = grey.shape
    # of 12 bits, as many cameras have; or with colours that are none
    pixels = {
        "mono16": (grey.astype("<u2") << 4).view(np.uint8),
        "big mono16": (grey.astype(">u2") << 4).astype(">u2").view(np.uint8),
        "yuv422": np.stack([np.full_like(grey, 128), grey], axis=2),
        "yuv422_yuy2": np.stack([grey, np.full_like(grey, 128)], axis=2),
    }.get(encoding, grey)
    is_big = encoding.startswith("big")
    bag = folder / encoding.replace(" ", "_")
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/image", raw.__msgtype__, typestore=store)
        content = np.ascontiguousarray(pixels).ravel()
        stamp = header(time(5, 0), "camera")
        message = raw(stamp, height, width, encoding[4 * is_big :], is_big, content.size // height, content)
        writer.write(topic, 0, store.serialize_cdr(message, raw.__msgtype__))
    tags = load_tags(folder / "tags.yaml")
    (shown,) = observe_frames(open_frames(bag), tags)
    (truth,) = observe_frames([frame], tags)
    assert {each.id for each in shown.first.detections} == {each.id for each in truth.first.detections}
    off = [
        np.abs(ours.corners - other.corners).max()
        for ours, other in zip(shown.first.detections, truth.first.detections, strict=True)
    ]
    assert max(off) < 0.35


def test_in_python_frames_that_are_none_are_refused_in_words(folder: Path) -> None:
    from spatial_replay.errors import UsageError
    from spatial_replay.perception import load_tags, observe_frames

    for image in (np.zeros((4, 4)), np.zeros((4, 4, 2), np.uint8), np.zeros((0, 4), np.uint8)):
        with pytest.raises(UsageError, match=r"give uint8, \(height, width\) grey or"):
            Frame(0, image)
    twice = [frame for frame in film(approaching(2), 1) for _ in range(2)]
    with pytest.raises(UsageError, match="give frames with increasing times"):
        list(observe_frames(twice, load_tags(folder / "tags.yaml")))


def test_in_python_frames_become_samples_for_a_monitor_and_a_recorder(folder: Path, tmp_path: Path) -> None:
    from spatial_replay.perception import load_tags, observe_frames, open_frames

    specification = load_specification(folder / "apart.spatial")
    monitor = Monitor(specification)
    verdicts = []
    with Recorder(tmp_path / "own.mcap", specifications=[specification]) as recorder:
        for seen in observe_frames(open_frames(folder / "table.mp4"), load_tags(folder / "tags.yaml")):
            recorder.write(seen.sample)
            verdicts.append(str(monitor.update(seen.sample).verdict))
    assert (verdicts[0], verdicts[-1]) == ("pending", "violated")
    assert payloads(tmp_path / "own.mcap", "/spatial/objects") == payloads(
        folder / "run.mcap", "/spatial/objects"
    )


@pytest.mark.parametrize("ending", ["mkv", "ts", "mp4"])
def test_a_video_that_breaks_off_is_recorded_up_to_there(
    ending: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # .mkv and .ts need no index at their end, nor does an .mp4 that has it at its beginning
    video = folder / f"cut.{ending}"
    _write_streamed(folder / "table.mp4", video)
    video.write_bytes(video.read_bytes()[: video.stat().st_size * 2 // 3])
    output, tags = folder / "cut.mcap", f"{folder}/tags.yaml"
    code = run(["record", "video", str(video), "--tags", tags, "-o", str(output)])
    assert 4 <= len(read_trace(output)) < COUNT
    assert run(["verify", str(output)]) == 0
    said = capsys.readouterr().err
    assert code == 3
    assert f"cut.{ending} breaks off after 0." in said


def _write_streamed(video: Path, output: Path) -> None:
    """Write a video again, frame by frame as it is, so that each is found without the end of the file."""
    import av

    options = {"movflags": "faststart"} if output.suffix == ".mp4" else {}
    with av.open(str(video)) as source, av.open(str(output), "w", options=options) as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                container.mux(packet)


def test_a_video_that_misses_its_last_frame_breaks_off(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import av

    whole = folder / "whole.mkv"
    _write_streamed(folder / "table.mp4", whole)
    with av.open(str(whole)) as container:
        at = [packet.pos for packet in container.demux(video=0) if packet.size]
    (folder / "less.mkv").write_bytes(whole.read_bytes()[: at[-1]])
    output = folder / "less.mcap"
    assert (
        run(["record", "video", f"{folder}/less.mkv", "--tags", f"{folder}/tags.yaml", "-o", f"{output}"])
        == 3
    )
    assert "less.mkv breaks off after 0.400 s, though its header says 0.480 s" in capsys.readouterr().err
    assert len(read_trace(output)) == COUNT - 1


@pytest.mark.parametrize("ending", ["mp4", "mkv", "avi"])
def test_uneven_frames_keep_their_stamps_and_the_video_is_whole(ending: str, folder: Path) -> None:
    from spatial_replay.perception import open_frames
    from spatial_replay.perception.video import VideoWriter

    times_ns = [40_000_000 * tick for tick in (0, 1, 2, 10, 11, 12, 20, 21, 22, 23)]
    with VideoWriter(folder / f"uneven.{ending}", 25) as writer:
        for time_ns, frame in zip(times_ns, film(approaching(10), 10), strict=True):
            writer.write(Frame(time_ns, frame.image))
    frames = open_frames(folder / f"uneven.{ending}")
    assert [frame.time_ns for frame in frames] == times_ns
    assert frames.faults == []


def test_images_that_claim_to_be_gigabytes_are_left_out_before_they_are_decoded(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from spatial_replay.perception.opencv import encode_jpeg

    store = get_typestore(Stores.ROS2_HUMBLE)
    time, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    compressed = store.types["sensor_msgs/msg/CompressedImage"]
    jpeg = encode_jpeg(next(film(approaching(2), 1)).image, 1000, 98)
    size = jpeg.index(b"\xff\xc0") + 5
    claims = [
        jpeg,
        jpeg[:size] + b"\xff\xff\xff\xff" + jpeg[size + 4 :],
        b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (60_000).to_bytes(4) * 2 + bytes(9),
        b"RIFF\x60\0\0\0WEBPVP8X\x0a\0\0\0" + bytes(4) + b"\xff\xff\xff\xff\xff\xff",
        b"BM" + bytes(60),
    ]
    with Writer(folder / "claims", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/camera/jpeg", compressed.__msgtype__, typestore=store)
        for index, data in enumerate(claims):
            message = compressed(header(time(5, index), "camera"), "jpeg", np.frombuffer(data, np.uint8))
            stamp_ns = 10**18 + index * 500_000_000
            writer.write(topic, stamp_ns, store.serialize_cdr(message, compressed.__msgtype__))
    output = folder / "claims.mcap"
    assert (
        run(["record", "video", f"{folder}/claims", "--tags", f"{folder}/tags.yaml", "-o", f"{output}"]) == 3
    )
    said = capsys.readouterr().err
    assert "/camera/jpeg after 0.500 s: an image of 65535 x 65535 is too large; left out" in said
    assert "after 1.000 s: an image of 60000 x 60000 is too large" in said
    assert "after 1.500 s: an image of 16777216 x 16777216 is too large" in said
    assert "after 2.000 s: an image is damaged, or neither JPEG nor PNG nor WebP" in said
    assert len(read_trace(output)) == 1


def test_a_video_without_time_stamps_asks_for_its_rate(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from spatial_replay.perception import open_frames

    frames = open_frames(folder / "table.mp4")
    (folder / "raw.h264").write_bytes(b"".join(frame.data for frame in frames))
    output = folder / "raw.mcap"
    arguments = ["record", "video", f"{folder}/raw.h264", "--tags", f"{folder}/tags.yaml", "-o", str(output)]
    assert run(arguments) == 3
    assert "raw.h264 has no time stamps; say how many frames a second it has" in capsys.readouterr().err
    assert not output.exists()
    assert run([*arguments, "--rate", "25"]) == 0
    assert "--rate" not in capsys.readouterr().err
    assert read_trace(output) == read_trace(folder / "run.mcap")
    # of one that has stamps, they are not dropped without a word
    assert run([*arguments[:2], f"{folder}/table.mp4", *arguments[3:], "--rate", "10"]) == 0
    assert "table.mp4 has time stamps (25 frames a second); 10 frames a second are" in capsys.readouterr().err
    assert read_trace(output).times_ns[1] == 100_000_000


BAD = {
    "no video": (["bad.mkv"], 3, "bad.mkv is no video that can be read"),
    "a recording that was not ended": (
        ["bad.mp4"],
        3,
        "bad.mp4 has no index, which is written when a recording",
    ),
    "not there": (["none.mp4"], 2, "no such file"),
    "a log without images": (["plain.mcap"], 2, "has no topic with images"),
    "no such topic": (["run.mcap", "--topic", "/camera/vide"], 2, "did you mean '/camera/video'?"),
    "a topic of a video": (["table.mp4", "--topic", "/a"], 2, "leave out --topic"),
    "a rate for a log": (["run.mcap", "--rate", "30"], 2, "leave out --rate"),
    "no camera": (["--camera", "93"], 2, "camera 93 cannot be opened"),
    "nothing": ([], 2, "give either videos or a log, or --camera N"),
    "a codec that is not there": (
        ["codec.mkv"],
        3,
        "codec.mkv has a video that no codec here decodes; convert it",
    ),
    "a video that cannot be copied": (["mpeg.avi", "--keep-video", "copy"], 2, "write --keep-video h264"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_refused_in_words_and_nothing_is_written(
    folder: Path, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, code, said = BAD[what]
    (folder / "bad.mkv").write_bytes(bytes(range(256)) * 9)
    # an .mp4 up to its frames: the index would follow them
    (folder / "bad.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(12) + b"\0\0\x10\0mdat" + bytes(900))
    (folder / "a.jsonl").write_text('{"time_ns": 0, "objects": []}\n')
    run(["record", "tracks", f"{folder}/a.jsonl", "-o", f"{folder}/plain.mcap"])
    _write_mpeg(folder / "mpeg.avi")
    _write_streamed(folder / "table.mp4", folder / "codec.mkv")
    whole = (folder / "codec.mkv").read_bytes()
    (folder / "codec.mkv").write_bytes(whole.replace(b"V_MPEG4/ISO/AVC", b"V_NONE4/ISO/XYZ"))
    given = [
        each if each.startswith(("-", "/")) or each in ("30", "93", "copy", "h264") else f"{folder}/{each}"
        for each in arguments
    ]
    output = folder / "refused.mcap"
    assert run(["record", "video", *given, "--tags", f"{folder}/tags.yaml", "-o", str(output)]) == code
    assert said in capsys.readouterr().err
    assert not output.exists()


def _write_mpeg(path: Path) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 480, 360, "yuv420p"
        for frame in film(approaching(2), 2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image, format="gray")))
        container.mux(stream.encode(None))


def test_a_video_of_another_codec_is_encoded_and_frames_keep_their_own_uneven_times(folder: Path) -> None:
    import av

    path = folder / "uneven.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=1000)
        stream.width, stream.height, stream.pix_fmt = 480, 360, "yuv420p"
        for number, frame in zip((0, 33, 101, 140), film(approaching(4), 4), strict=True):
            picture = av.VideoFrame.from_ndarray(frame.image, format="gray")
            picture.pts = number
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    output = folder / "uneven.mcap"
    assert run(["record", "video", str(path), "--tags", f"{folder}/tags.yaml", "-o", str(output)]) == 0
    assert (read_trace(output).times_ns // 10**6).tolist() == [0, 33, 101, 140]
    assert len(payloads(output, "/camera/video")) == 4


def test_a_camera_that_is_unplugged_leaves_a_whole_log(folder: Path) -> None:
    cv2 = pytest.importorskip("cv2")

    from spatial_replay.perception import CameraFrames, parse_tags
    from spatial_replay.runs.record_video import record_cameras

    # for OpenCV, an unplugged camera is a capture that ends: here of a pipe whose other end stops in a frame
    _write_streamed(folder / "table.mp4", folder / "plugged.ts")
    sent = (folder / "plugged.ts").read_bytes()
    os.mkfifo(folder / "camera")
    cable = Thread(target=(folder / "camera").write_bytes, args=(sent[: len(sent) * 2 // 3],))
    cable.start()
    camera = CameraFrames(0, opened=lambda number: cv2.VideoCapture(str(folder / "camera")))
    seen = record_cameras([camera], parse_tags(TABLE), folder / "camera.mcap")
    cable.join()
    assert 4 <= seen.samples < COUNT and "is it unplugged?" in seen.faults[0]
    assert len(read_trace(folder / "camera.mcap")) == seen.samples
    assert run(["verify", f"{folder}/camera.mcap"]) == 0


def test_detections_that_a_robot_recorded_say_what_their_images_say(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from spatial_replay.perception import open_frames
    from spatial_replay.perception.opencv import TagDetector

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, fields in (
        ("Point", "float64 x\nfloat64 y\n"),
        ("AprilTagDetection", "string family\nint32 id\nPoint centre\nPoint[4] corners\n"),
        ("AprilTagDetectionArray", "std_msgs/Header header\nAprilTagDetection[] detections\n"),
    ):
        store.register(get_types_from_msg(fields, f"apriltag_msgs/msg/{name}"))
    point, detection, array = (
        store.types[f"apriltag_msgs/msg/{name}"]
        for name in ("Point", "AprilTagDetection", "AprilTagDetectionArray")
    )
    time, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    detector = TagDetector("36h11")
    with Writer(folder / "robot", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/detections", array.__msgtype__, typestore=store)
        for frame in open_frames(folder / "table.mp4"):
            listed = [
                # detectors of the AprilTag family count pixels from their corners, half a pixel further
                detection("tag36h11", number, point(0, 0), [point(*corner) for corner in corners + 0.5])
                for number, corners, _ in detector.detect(frame.image)
            ]
            # a tag of another family is not the one that the tags file means
            listed.append(detection("tag16h5", 0, point(0, 0), [point(*corner) for corner in np.eye(4, 2)]))
            message = array(header(time(5, frame.time_ns), "camera"), listed)
            writer.write(topic, 10**18 + frame.time_ns, store.serialize_cdr(message, array.__msgtype__))
    arguments = ["record", "video", f"{folder}/robot", "--tags", f"{folder}/tags.yaml"]
    output = recorded(folder, "robot", "--topic", "/detections")
    trace, of_video = read_trace(output), read_trace(folder / "run.mcap")
    assert (trace.times_ns - 5 * 10**9).tolist() == of_video.times_ns.tolist()
    assert np.allclose(trace.uncertainty, of_video.uncertainty)
    assert np.allclose(trace.footprints.vertices, of_video.footprints.vertices, atol=1e-9)
    assert len(payloads(output, "/detections")) == COUNT
    assert run(["verify", str(output)]) == 0
    capsys.readouterr()
    refused = folder / "refused.mcap"
    assert run([*arguments, "--keep-video", "h264", "-o", f"{refused}"]) == 2
    assert "detections have no images to encode" in capsys.readouterr().err
    (folder / "pixels.yaml").write_text("objects: {red: {tag: 0, disc: 20}}\nplane: image\n")
    arguments[-1] = f"{folder}/pixels.yaml"
    assert run([*arguments, "-o", f"{refused}"]) == 2
    assert "give reference tags, or map the topic" in capsys.readouterr().err
    assert run(["tags", "calibrate", f"{folder}/robot", "--tags", f"{folder}/tags.yaml"]) == 2
    assert "a camera is calibrated from its images" in capsys.readouterr().err
    assert not refused.exists()
