"""Track files: what is read, and what is reported about the rest."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pytest

from spatial_replay import Footprint, LogError, MissingFileError, Trace, UsageError, read_trace
from spatial_replay.logs.read_options import MOST_FAULTS
from spatial_replay.logs.source import BLOCK_SAMPLES
from spatial_replay.sources import open_source

SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]


def line(time_ns, *objects, **more):
    return json.dumps({"time_ns": time_ns, "objects": list(objects), **more})


def cup(**more):
    return {"name": "cup", "polygon": SQUARE, **more}


@pytest.fixture
def jsonl(tmp_path):
    def write(*lines):
        path = tmp_path / "run.jsonl"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write


def test_a_sample_says_everything_about_an_object(jsonl):
    parts = [{"vertices": [[2, 3]], "radius": 0.5}]
    plate = {
        "name": "plate",
        "class": "dish",
        "parts": parts,
        "height": [0, 0.1],
        "yaw": 1.5,
        "uncertainty": 0.2,
    }
    (sample,) = read_trace(jsonl(line(7, cup(), plate, signals={"battery": 0.8}))).samples()
    assert sample.time_ns == 7
    assert sample.objects["cup"].footprint == Footprint.box(0, 0, 1, 1)
    assert (
        sample.objects["cup"].yaw is sample.objects["cup"].height is sample.objects["cup"].class_name is None
    )
    plate = sample.objects["plate"]
    assert plate.footprint == Footprint.disc(2, 3, 0.5)
    assert (plate.class_name, plate.height, plate.yaw, plate.uncertainty) == ("dish", (0, 0.1), 1.5, 0.2)
    assert sample.signals == {"battery": 0.8}


@pytest.mark.parametrize(
    ("bad", "reported"),
    [
        ("{", "not JSON"),
        ("[" * 100_000, "nested too deeply"),
        ("[1]", "a list"),
        (line(1.5), "time_ns is 1.5"),
        (line(-1), "time_ns is -1"),
        (line(2**63), "time_ns"),
        (line(True), "time_ns is true"),
        (line("1"), "time_ns"),
        ('{"objects": []}', "time_ns is null"),
        (line(0), "not after 0"),
        (line(1, cup(), cup()), "'cup' is there twice"),
        (line(1, cup(colour="red")), "unknown key 'colour'"),
        (line(1, frame="x"), "unknown key 'frame'"),
        (line(1, {"polygon": SQUARE}), "name is null"),
        (line(1, {"name": "", "polygon": SQUARE}), "not empty"),
        (line(1, {"name": "\ud800", "polygon": SQUARE}), "name"),
        (line(1, {"name": "cup"}), "one of polygon and parts"),
        (line(1, cup(parts=[])), "one of polygon and parts"),
        (line(1, {"name": "cup", "parts": []}), "no footprint"),
        (line(1, {"name": "cup", "polygon": []}), "without vertices"),
        (line(1, {"name": "cup", "polygon": [[0, 0, 0]]}), "[x, y]"),
        (line(1, {"name": "cup", "polygon": [["0", 0]]}), "give a number"),
        (line(1, {"name": "cup", "polygon": [[True, 0]]}), "give a number"),
        (line(1, {"name": "cup", "polygon": [[10**400, 0]]}), "fits a double"),
        (line(1, {"name": "cup", "polygon": [[0, 0], [2, 2], [2, 0], [0, 1]]}), "cross"),
        (line(1, {"name": "cup", "parts": [{"vertices": [[0, 0]], "radius": -1}]}), "negative radius"),
        (line(1, cup(height=[1, 0])), "bottom is above"),
        (line(1, cup(height=[1])), "[bottom, top]"),
        (line(1, cup(uncertainty=-1)), "negative uncertainty"),
        (line(1, cup(**{"class": 3})), "class is 3"),
        (line(1, signals={"force": [1]}), "signal 'force'"),
        (line(1, signals=[1]), "signals are a list"),
    ],
)
def test_a_line_that_is_not_a_sample_is_left_out_and_reported(jsonl, bad, reported):
    path = jsonl(line(0, cup()), bad, line(9, cup()))
    trace = read_trace(path, allow_damage=True)
    assert trace.times_ns.tolist() == [0, 9]
    (fault,) = trace.faults
    assert fault.startswith("run.jsonl:2: ")
    assert reported in fault
    with pytest.raises(LogError, match=r"run\.jsonl:2: "):
        read_trace(path)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "null", "1e999"])
@pytest.mark.parametrize(
    "place",
    [
        '"polygon": [[0, 0], [1, {}], [0, 1]]',
        '"parts": [{{"vertices": [[0, 0]], "radius": {}}}]',
        '"polygon": [[0, 0]], "height": [0, {}]',
        '"polygon": [[0, 0]], "uncertainty": {}',
    ],
)
def test_a_number_that_is_not_finite_makes_the_object_unknown(jsonl, number, place):
    bad = '{"time_ns": 0, "objects": [{"name": "cup", ' + place.format(number) + "}]}"
    trace = read_trace(jsonl(bad))
    assert trace.unreadable_count == 1
    assert trace.names == ("cup",)
    assert trace.faults == ()


def test_a_signal_may_be_unknown(jsonl):
    trace = read_trace(jsonl(line(0, signals={"force": None}), line(1, signals={"force": 2})))
    assert np.isnan(trace.signals["force"][0])
    assert trace.signals["force"][1] == 2


def test_clockwise_corners_are_the_same_polygon(jsonl):
    turned = {"name": "cup", "polygon": SQUARE[::-1]}
    (one, other) = read_trace(jsonl(line(0, cup()), line(1, turned))).samples()
    assert one.objects["cup"].footprint == other.objects["cup"].footprint


def test_a_polygon_that_is_not_convex_is_cut_up_or_filled(jsonl):
    corner = {"name": "cup", "polygon": [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]]}
    path = jsonl(line(0, corner), line(1, cup()))
    assert len(next(read_trace(path).samples()).objects["cup"].footprint.parts) > 1
    hull = next(read_trace(path, concave="hull").samples()).objects["cup"].footprint
    assert hull == Footprint.polygon(corner["polygon"], concave="hull")


def test_a_truncated_gzip_file_gives_what_came_before(tmp_path):
    lines = [line(time, cup(yaw=time * 0.37)) for time in range(5000)]
    path = tmp_path / "run.jsonl.gz"
    content = gzip.compress("\n".join(lines).encode())
    path.write_bytes(content[: len(content) // 2])
    trace = read_trace(path, allow_damage=True)
    assert 0 < len(trace) < 5000
    assert trace.times_ns.tolist() == list(range(len(trace)))
    assert "breaks off" in trace.faults[-1]


def test_gzip_is_recognised_by_content(tmp_path):
    path = tmp_path / "run.jsonl"
    path.write_bytes(gzip.compress(line(0, cup()).encode()))
    assert len(read_trace(path)) == 1


def test_bytes_that_are_not_utf8_cost_their_line(tmp_path):
    path = tmp_path / "run.jsonl"
    path.write_bytes(
        b"\xef\xbb\xbf" + line(0).encode() + b'\n{"time_ns": 1, "\xff": 2}\n\n' + line(2).encode()
    )
    trace = read_trace(path, allow_damage=True)
    assert trace.times_ns.tolist() == [0, 2]
    assert trace.faults == ("run.jsonl:2: byte 17 of the line is not UTF-8",)


def test_many_faults_are_counted(jsonl):
    path = jsonl(line(0), *["{"] * (MOST_FAULTS + 50))
    trace = read_trace(path, allow_damage=True)
    assert len(trace.faults) == MOST_FAULTS + 1
    assert "50 more" in trace.faults[-1]


def test_a_file_without_a_sample_is_an_error(tmp_path, jsonl):
    with pytest.raises(MissingFileError, match=r"nothing\.jsonl: no such file; check the path$"):
        open_source(tmp_path / "nothing.jsonl")
    with pytest.raises(MissingFileError, match=r"there is nothing in this folder; give the path of a log$"):
        open_source(tmp_path)
    empty = tmp_path / "empty.jsonl"
    empty.touch()
    with pytest.raises(LogError, match="empty"):
        open_source(empty)
    with pytest.raises(
        MissingFileError, match=r"give the path of a log, such as .*empty\.jsonl; batch takes a folder$"
    ):
        open_source(tmp_path)
    other = tmp_path / "picture.png"
    other.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    with pytest.raises(UsageError, match=r"not a log in a known format.*`record video`"):
        open_source(other)
    # what is called a log is a damaged one
    with pytest.raises(LogError, match="not a log in a known format"):
        open_source(other.rename(tmp_path / "picture.mcap"))
    with pytest.raises(LogError, match=r"holds no sample: run\.jsonl:1"):
        read_trace(jsonl('{"a": 1}'))
    crossing = cup(polygon=[[0, 0], [2, 2], [2, 0], [0, 1]])
    with pytest.raises(LogError, match=r"holds no sample: run\.jsonl:1: .*cross"):
        read_trace(jsonl(line(0, crossing)))
    broken = tmp_path / "broken.jsonl.gz"
    broken.write_bytes(gzip.compress(line(0).encode())[:12])
    with pytest.raises(LogError, match="broken"):
        read_trace(broken)


def test_a_mapping_is_refused_where_none_is_needed(jsonl):
    with pytest.raises(UsageError, match="leave it out"):
        read_trace(jsonl(line(0)), mapping="turtles.yaml")


def test_blocks_are_bounded_and_windowed(jsonl):
    path = jsonl(*(line(time) for time in range(20_000)))
    blocks = [len(block.trace) for block in open_source(path).iter_blocks()]
    assert len(blocks) > 1 and max(blocks) <= BLOCK_SAMPLES
    assert sum(blocks) == 20_000
    window = Trace.concatenate([block.trace for block in open_source(path).iter_blocks(10, 13)])
    assert window.times_ns.tolist() == [10, 11, 12]


def test_the_published_recordings_are_read_whole(data_folder):
    trace = read_trace(data_folder / "paper" / "blocks_moving_passage.jsonl.gz")
    assert (len(trace), len(trace.names), trace.unreadable_count) == (1579, 6, 0)


HEADER = "time_ns,name,class,x,y,yaw,length,width"


@pytest.fixture
def csv(tmp_path):
    def write(*lines):
        path = tmp_path / "run.csv"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write


def test_lines_of_equal_time_make_a_sample(csv):
    path = csv(
        HEADER, "0,car,vehicle,1,2,0,4,2", "0,bike,,5,5,,2,1", "10,car,vehicle,1,2,1.5707963267948966,4,2"
    )
    first, second = read_trace(path).samples()
    assert first.objects["car"].footprint == Footprint.box(-1, 1, 3, 3)
    assert (first.objects["car"].class_name, first.objects["car"].yaw) == ("vehicle", 0)
    assert (first.objects["bike"].class_name, first.objects["bike"].yaw) == (None, None)
    corners = second.objects["car"].footprint.parts[0].vertices
    assert np.allclose([corners.min(axis=0), corners.max(axis=0)], [[0, 0], [2, 4]])


def test_columns_of_a_csv_come_in_any_order(csv):
    path = csv("name,time_ns,x,y,length,width,yaw,class", "car,3,0,0,2,2,0,vehicle")
    assert read_trace(path).times_ns.tolist() == [3]


@pytest.mark.parametrize(
    ("bad", "reported"),
    [
        ("5,car", "2 cells"),
        ("5,car,vehicle,1,2,0,-4,2", "at least 0"),
        ("5,,vehicle,1,2,0,4,2", "name is empty"),
        ("5,car,vehicle,one,2,0,4,2", "x is 'one'"),
        ("-5,car,vehicle,1,2,0,4,2", "time_ns is '-5'"),
        ('5,"car,vehicle,1,2,0,4,2', "not CSV"),
    ],
)
def test_a_csv_line_that_is_not_an_object_costs_its_sample(csv, bad, reported):
    path = csv(HEADER, "0,car,vehicle,1,2,0,4,2", bad, "9,car,vehicle,1,2,0,4,2")
    trace = read_trace(path, allow_damage=True)
    assert trace.times_ns.tolist() == [0, 9]
    (fault,) = trace.faults
    assert fault.startswith("run.csv:3: ")
    assert reported in fault


@pytest.mark.parametrize(("yaw", "doubtful"), [("90", {"car"}), ("-12.5", set())])
def test_a_csv_in_degrees_is_doubtful(csv, yaw, doubtful):
    path = csv(HEADER, f"0,car,vehicle,1,2,{yaw},4,2", f"9,car,vehicle,1,3,{yaw},4,2")
    doubts = [doubt for block in open_source(path).iter_blocks() for doubt in block.doubts]
    assert {name for doubt in doubts for name in doubt.objects} == doubtful


def test_a_csv_whose_yaw_counts_turns_is_not_doubtful(csv):
    lines = (f"{tick * 10**9},car,vehicle,{tick},2,{tick / 2},4,2" for tick in range(80))
    assert [block.doubts for block in open_source(csv(HEADER, *lines)).iter_blocks()] == [()]


@pytest.mark.parametrize(("step", "doubtful"), [(100_000, ["log_time_unit"]), (1_000_000, [])])
def test_a_csv_with_times_in_microseconds_is_doubtful(csv, step, doubtful):
    path = csv(HEADER, *(f"{tick * step},car,vehicle,{tick},2,0,4,2" for tick in range(20)))
    blocks = open_source(path).iter_blocks()
    assert [doubt.assumption for block in blocks for doubt in block.doubts] == doubtful


def test_a_csv_number_may_be_unknown(csv):
    assert read_trace(csv(HEADER, "0,car,vehicle,,2,0,4,2")).unreadable_count == 1
    assert read_trace(csv(HEADER, "0,car,vehicle,1,2,nan,4,2")).unreadable_count == 1


def test_a_csv_without_its_columns_is_an_error(csv):
    with pytest.raises(LogError, match="a track CSV has time_ns,name"):
        read_trace(csv("time_ns,name,x,y", "0,car,1,2"))


@pytest.mark.parametrize("given", [None, 3, [Footprint.box(0, 0, 1, 1)]])
def test_a_value_that_is_not_a_path_is_refused(given):
    with pytest.raises(UsageError, match=r"^path is .*; give the path of a log; Trace\.from_samples"):
        read_trace(given)


def test_lines_without_end_that_are_blank_are_not_read_to_their_end(tmp_path):
    path = tmp_path / "run.jsonl.gz"
    sample = json.dumps({"time_ns": 0, "objects": [{"name": "cup", "polygon": [[0, 0], [1, 0], [1, 1]]}]})
    with gzip.open(path, "wb", 1) as stream:
        stream.write(sample.encode() + b"\n")
        for _ in range(11):
            stream.write(b"\n" * 1_000_000)
        stream.write(b"{")
    trace = read_trace(path, allow_damage=True)
    assert len(trace) == 1
    assert "gz:10000002: it has more than 10,000,000 blank lines" in trace.faults[-1]
