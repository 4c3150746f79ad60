"""Logs at addresses: what they give is what the same logs give on this machine, of which little is moved."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from urllib.request import Request, urlopen

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

import spatial_replay as sr
from logs.servers import free_port, running, s3_server
from logs.web_server import WebServer, serving
from spatial_replay import LogError, MissingFileError, UsageError
from spatial_replay.cli import run
from spatial_replay.errors import RemoteError
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import Channel, Messages, Schema
from spatial_replay.logs.remote import joined_ranges, matching_addresses

RECORDINGS = Path(__file__).parents[2] / "recordings"
SPEC = sr.parse_specification("G (cup dist plate >= 0.1)")
IMAGE = Channel("/camera/image", "protobuf", Schema("foxglove.CompressedImage", "protobuf", b""))
PERIOD_NS = 50_000_000
IMAGES = np.random.default_rng(4)


def samples(count: int, start_ns: int = 0) -> sr.Trace:
    plate = sr.Footprint.box(5, 0, 6, 1)
    return sr.Trace.from_samples(
        sr.Sample(
            start_ns + i * PERIOD_NS,
            {"cup": sr.Footprint.box(i / count, 0, 1 + i / count, 1), "plate": plate},
        )
        for i in range(count)
    )


def drive(folder: Path, count: int = 160, image_bytes: int = 30_000) -> Path:
    """Write a log of samples with camera images between them: 20 a second of both."""
    plain, path = folder / "plain.mcap", folder / "drive.mcap"
    sr.replay_log(samples(count), SPEC, output=plain)
    with plain.open("rb") as stream, path.open("wb") as target, LogWriter(target) as writer:
        reader = make_reader(stream)
        for each in reader.iter_metadata():
            writer.add_metadata(each.name, each.metadata)
        for each in reader.iter_attachments():
            writer.add_attachment(each.name, each.media_type, each.data)
        for schema, channel, message in reader.iter_messages():
            ours = Channel(
                channel.topic, channel.message_encoding, Schema(schema.name, schema.encoding, schema.data)
            )
            writer.write(ours, message.log_time, message.data, sequence=message.sequence)
            if channel.topic == "/spatial/objects":
                writer.write(IMAGE, message.log_time + 1, IMAGES.bytes(image_bytes))
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("drive"))


@pytest.fixture
def server(log: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[WebServer]:
    monkeypatch.setenv("SPATIAL_REPLAY_CACHE", str(tmp_path / "cache"))
    with serving({"drive.mcap": log.read_bytes()}) as server:
        yield server


def test_a_replay_of_an_address_gives_what_a_replay_of_the_file_gives(
    server: WebServer, log: Path, tmp_path: Path
) -> None:
    there, here = tmp_path / "there.mcap", tmp_path / "here.mcap"
    sr.replay_log(server.url("drive.mcap"), SPEC, output=there)
    sr.replay_log(log, SPEC, output=here)
    assert there.read_bytes() == here.read_bytes()


def test_a_window_out_of_a_long_log_takes_three_rounds_and_no_images(server: WebServer) -> None:
    replayed = sr.replay_log(server.url("drive.mcap"), SPEC, start_ns=5 * 10**9, end_ns=7 * 10**9)
    assert (replayed.samples, replayed.first_ns) == (40, 0)
    # the end and the beginning at the same time, the chunk of the first sample, then two or three chunks
    assert server.requests <= 6
    assert server.sent < 700_000 < len(server.files["drive.mcap"]) / 6


def test_a_window_with_images_moves_little_more_than_its_chunks(server: WebServer, tmp_path: Path) -> None:
    start_ns, end_ns = 5 * 10**9, 7 * 10**9
    sr.replay_log(
        server.url("drive.mcap"), SPEC, output=tmp_path / "out.mcap", start_ns=start_ns, end_ns=end_ns
    )
    summary = make_reader(io.BytesIO(server.files["drive.mcap"])).get_summary()
    assert summary is not None
    needed = sum(
        each.chunk_length
        for each in summary.chunk_indexes
        if each.message_start_time < end_ns and each.message_end_time >= start_ns
    )
    index = 2**19 + 2**16
    assert needed < server.sent < 1.1 * needed + index + 100_000


@pytest.mark.parametrize(
    "command",
    [
        "replay",
        "info",
        "explain",
        "verify",
        "export -o out.csv",
        "report -o out.html",
        "check SPEC --log",
        "clip -o out.mcap",
        "diff --spec SPEC --spec SPEC",
        "tune --spec SPEC --vary least=0:2 --good",
        "record tracks -o out.mcap",
    ],
    ids=lambda command: command.split()[0],
)
def test_every_command_that_takes_a_log_takes_an_address(
    command: str,
    server: WebServer,
    log: Path,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.spatial").write_text("const least = 0.1\nspec apart = G (cup dist plate >= least)")
    name, *options = command.replace("SPEC", "s.spatial").split()
    said = []
    for each in (str(log), server.url("drive.mcap")):
        code = run([name, *options, each])
        captured = capsys.readouterr()
        said.append((code, captured.out, captured.err))
    assert said[0] == said[1]
    assert said[0][0] in (0, 1)


def test_an_external_log_at_an_address_is_read_with_its_mapping(data_folder: Path, tmp_path: Path) -> None:
    (bag,) = (data_folder / "bags/two_turtles_mcap").glob("*.mcap")
    mapping = tmp_path / "turtles.yaml"
    mapping.write_text(
        "topics:\n  /turtle1/pose: {name: a, position: [x, y], shape: {disc: 0.5}}\n"
        "  /turtle2/pose: {name: b, position: [x, y], shape: {disc: 0.5}}\n"
        "sample: {topic: /turtle1/pose}\n"
    )
    with serving({bag.name: bag.read_bytes()}) as server:
        there, here = (sr.read_trace(each, mapping=mapping) for each in (server.url(bag.name), bag))
    assert there.times_ns.tolist() == here.times_ns.tolist()
    assert there.footprints.vertices.tolist() == here.footprints.vertices.tolist()


TURTLES = """\
topics:
  /turtle1/pose: {name: a, position: [x, y], shape: {disc: 0.5}}
  /turtle2/pose: {name: b, position: [x, y], shape: {disc: 0.5}}
sample: {topic: /turtle1/pose}
"""


@pytest.mark.parametrize("bag", ["two_turtles_mcap", "two_turtles_sqlite3"])
def test_a_ros2_bag_at_an_address_is_its_folder_and_its_mapping_and_specification_have_addresses(
    bag: str,
    data_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setenv("SPATIAL_REPLAY_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    files = {"t.yaml": TURTLES.encode(), "near.spatial": b"spec near = F (a dist b <= 2)"}
    for name, content in files.items():
        Path(name).write_bytes(content)
    folder = data_folder / "bags" / bag
    served = {f"{bag}/{each.name}": each.read_bytes() for each in folder.iterdir() if each.is_file()}
    with serving({**files, **served}) as server:
        here = ["replay", str(folder), "--mapping", "t.yaml", "--spec", "near.spatial"]
        there = ["--mapping", server.url("t.yaml"), "--spec", server.url("near.spatial")]
        code = run(here)
        said = capsys.readouterr()
        for address in (f"{bag}/", bag):
            assert run(["replay", server.url(address), *there]) == code
            assert capsys.readouterr().out == said.out
        # the second time, the copies are there
        assert caplog.text.count("downloading") == 1
        results = ["batch", server.url(f"{bag}/"), *there, "-o", "results", "--jobs", "1"]
        for news in ("all evaluated now", "1 known"):
            assert run(results) == code
            assert news in capsys.readouterr().out
        del server.files[f"{bag}/metadata.yaml"]
        assert run(["info", server.url(f"{bag}/")]) == 2
        assert "there is no such file" in capsys.readouterr().err


def test_a_log_that_is_not_read_in_parts_is_downloaded_once_for_each_version(
    server: WebServer, caplog: pytest.LogCaptureFixture
) -> None:
    tracks = (RECORDINGS / "table.jsonl").read_bytes()
    server.files["table.jsonl"] = tracks
    times = [sr.read_trace(server.url("table.jsonl")).times_ns.tolist() for _ in range(2)]
    assert times[0] == times[1] == sr.read_trace(RECORDINGS / "table.jsonl").times_ns.tolist()
    assert [record.getMessage().partition(": ")[2][:11] for record in caplog.records] == ["downloading"]
    server.files["table.jsonl"] = b"".join(tracks.splitlines(keepends=True)[:10])
    assert len(sr.read_trace(server.url("table.jsonl"))) == 10


def test_an_mcap_log_without_its_end_is_downloaded_and_read_as_far_as_it_goes(
    server: WebServer, caplog: pytest.LogCaptureFixture
) -> None:
    server.files["broken.mcap"] = server.files["drive.mcap"][:-1_000_000]
    trace = sr.read_trace(server.url("broken.mcap"), allow_damage=True)
    assert 100 < len(trace) <= 160 and trace.faults
    assert "it has no index" in caplog.text


def test_downloads_stay_within_their_limit(
    server: WebServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SPATIAL_REPLAY_DOWNLOADS", "0.0004")
    tracks = (RECORDINGS / "table.jsonl").read_bytes()
    server.files |= {f"{i}.jsonl": tracks for i in range(4)} | {"large.jsonl": tracks * 3}
    for i in range(4):
        sr.read_trace(server.url(f"{i}.jsonl"))
    copies = list((tmp_path / "cache/downloads").rglob("*.jsonl"))
    assert {"3.jsonl"} < {each.name for each in copies}
    assert sum(each.stat().st_size for each in copies) <= 400_000
    with pytest.raises(LogError, match=r"large\.jsonl has 0\.00 GB.* SPATIAL_REPLAY_DOWNLOADS"):
        sr.read_trace(server.url("large.jsonl"))


def test_throttling_and_connections_that_break_off_are_tried_again(server: WebServer) -> None:
    server.fault = lambda number: {1: 503, 2: "cut", 4: 503, 5: "cut", 7: "cut"}.get(number)
    assert len(sr.read_trace(server.url("drive.mcap"))) == 160


def test_a_server_that_never_sends_the_whole_answer_is_an_error_with_its_address(server: WebServer) -> None:
    server.fault = lambda number: "cut"
    with pytest.raises(RemoteError, match=r"http://127.*drive\.mcap cannot be read: .*; check the network"):
        sr.read_trace(server.url("drive.mcap"))


def test_a_log_that_is_replaced_while_it_is_read_is_an_error_never_a_mixture(server: WebServer) -> None:
    content = server.files["drive.mcap"]

    def replace(number: int) -> None:
        # the index is known by now
        if number == 3:
            server.files["drive.mcap"] = content[:-1] + b"\x00"

    server.fault = replace
    with pytest.raises(RemoteError, match="was replaced while it was read; run the command again"):
        sr.read_trace(server.url("drive.mcap"))


def test_addresses_that_do_not_work_say_what_helps(
    server: WebServer, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(MissingFileError, match="there is no such file; check the address"):
        sr.read_trace(server.url("none.mcap"))
    with pytest.raises(UsageError, match="names no file"):
        sr.read_trace("s3://fleet")
    with pytest.raises(MissingFileError, match="address of a bag's folder"):
        sr.read_trace(server.url("2026-11/"))
    with pytest.raises(UsageError, match="is an address; write to this machine"):
        sr.replay_log(server.url("drive.mcap"), SPEC, output="s3://fleet/out.mcap")
    server.fault = lambda number: 403
    assert run(["info", server.url("drive.mcap?signature=secret")]) == 2
    said = capsys.readouterr().err
    assert "drive.mcap: access denied" in said and "secret" not in said


def test_without_obstore_an_address_says_what_to_install(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['obstore'] = None\n"
        "from spatial_replay.cli import run; sys.exit(run(['info', 's3://fleet/run.mcap']))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "pip install 'spatial-replay[remote]'" in done.stderr


def test_a_bucket_of_an_s3_server_is_listed_and_read(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPATIAL_REPLAY_CACHE", str(tmp_path))
    with s3_server("fleet", monkeypatch) as server:
        import obstore
        from obstore.store import S3Store

        bucket = S3Store("fleet", client_options={"allow_http": True})
        obstore.put(bucket, "2026-11/drive 1+2.mcap", log.read_bytes())
        obstore.put(bucket, "2026-11/table.jsonl", (RECORDINGS / "table.jsonl").read_bytes())
        assert matching_addresses("s3://fleet/2026-11/*.mcap") == ["s3://fleet/2026-11/drive 1+2.mcap"]
        assert len(matching_addresses("s3://fleet/")) == 2
        there = sr.replay_log("s3://fleet/2026-11/drive 1+2.mcap", SPEC)
        assert dict(there.certificate) == dict(sr.replay_log(log, SPEC).certificate)
        assert len(sr.read_trace("s3://fleet/2026-11/table.jsonl")) == 300
        with pytest.raises(MissingFileError, match="there is no such file"):
            sr.read_trace("s3://fleet/none.mcap")
        for address in ("s3://fleet/2026//run.mcap", "s3://fleet//run.mcap"):
            with pytest.raises(UsageError, match="// or a leading / in its key; copy it to a key without"):
                sr.read_trace(address)
        urlopen(Request(f"{server}/fleet/2025//run.mcap", b"", method="PUT")).close()
        with pytest.raises(RemoteError, match=r"'2025//run\.mcap' cannot be read: // or a leading /"):
            matching_addresses("s3://fleet/**/*.mcap")
        assert len(matching_addresses("s3://fleet/2026-11/")) == 2

        # the protocol of Google's buckets is that of S3, but for the signatures
        everyone = {"Effect": "Allow", "Principal": "*", "Action": "s3:*", "Resource": "arn:aws:s3:::fleet*"}
        policy = json.dumps({"Version": "2012-10-17", "Statement": [everyone]}).encode()
        as_json = {"Content-Type": "application/json"}
        urlopen(Request(f"{server}/fleet?policy", policy, as_json, method="PUT")).close()
        account = {"gcs_base_url": server, "disable_oauth": True}
        account |= dict.fromkeys(("client_email", "private_key", "private_key_id"), "")
        (tmp_path / "account.json").write_text(json.dumps(account))
        monkeypatch.setenv("GOOGLE_SERVICE_ACCOUNT", str(tmp_path / "account.json"))
        (found,) = matching_addresses("gs://fleet/2026-11/*.mcap")
        assert dict(sr.replay_log(found, SPEC).certificate) == dict(there.certificate)


@pytest.mark.skipif(shutil.which("nginx") is None, reason="nginx is not installed")
def test_nginx_serves_a_log_in_parts(log: Path, tmp_path: Path) -> None:
    port = free_port()
    places = "".join(
        f"{kind}_temp_path {tmp_path / kind};"
        for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (tmp_path / "nginx.conf").write_text(
        f"daemon off; pid {tmp_path}/pid; events {{}} http {{ access_log {tmp_path}/access.log; {places}"
        f" server {{ listen 127.0.0.1:{port}; root {log.parent}; }} }}"
    )
    # nginx's workers give up the rights of the user who starts them
    user = ["-g", "user root;"] if os.getuid() == 0 else []
    command = ["nginx", "-c", f"{tmp_path}/nginx.conf", "-e", f"{tmp_path}/error.log", *user]
    with running(command, port):
        replayed = sr.replay_log(
            f"http://127.0.0.1:{port}/drive.mcap", SPEC, start_ns=10**9, end_ns=2 * 10**9
        )
    assert replayed.samples == 20
    statuses = [line.split('" ')[1].split()[0] for line in (tmp_path / "access.log").read_text().splitlines()]
    assert set(statuses) == {"206"}


def test_a_log_of_images_and_samples_is_what_the_mcap_library_reads(log: Path) -> None:
    with log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        topics = [channel.topic for _, channel, _ in reader.iter_messages()]
        summary = reader.get_summary()
    assert topics.count("/camera/image") == topics.count("/spatial/objects") == 160
    assert summary is not None
    kinds = [
        {summary.channels[number].topic.startswith("/spatial/") for number in chunk.message_index_offsets}
        for chunk in summary.chunk_indexes
    ]
    assert {True} in kinds and {False} in kinds and {True, False} not in kinds


@given(
    st.lists(
        st.tuples(st.sampled_from([0, 1]), st.integers(0, 3 * 10**9), st.integers(0, 60_000)), max_size=30
    ),
    st.lists(st.integers(0, 30)),
)
def test_how_messages_are_divided_among_calls_changes_no_byte(
    written: list[tuple[int, int, int]], cuts: list[int]
) -> None:
    ours = Channel("/spatial/scene", "json", Schema("words", "jsonschema", b"{}"))
    theirs = Channel("/plan/path", "json", ours.schema)

    def log_of(bounds: list[int]) -> bytes:
        stream = io.BytesIO()
        with LogWriter(stream) as writer:
            for begin, end in pairwise(bounds):
                part = written[begin:end]
                times = np.array([time_ns for _, time_ns, _ in part], np.int64)
                channel = np.array([lane for lane, _, _ in part], np.int64)
                payloads = [bytes(size) for *_, size in part]
                numbers = np.arange(begin, begin + len(part))
                writer.write_messages(
                    Messages({0: ours, 1: theirs}, channel, numbers, times, times, payloads)
                )
        return stream.getvalue()

    count = len(written)
    whole = log_of([0, count])
    assert log_of([0, *sorted(cut for cut in cuts if cut < count), count]) == whole
    assert log_of(list(range(count + 1))) == whole
    read = [message.log_time for *_, message in make_reader(io.BytesIO(whole)).iter_messages()]
    assert read == sorted(time_ns for _, time_ns, _ in written)


@given(st.lists(st.tuples(st.integers(0, 10_000), st.integers(1, 500)), min_size=1, max_size=20))
def test_joined_ranges_cover_what_was_wanted_and_waste_less_than_a_tenth(
    parts: list[tuple[int, int]],
) -> None:
    ranges = [(begin, begin + size) for begin, size in parts]
    joined = joined_ranges(ranges)
    wanted = {byte for begin, end in ranges for byte in range(begin, end)}
    read = [byte for begin, end in joined for byte in range(begin, end)]
    assert wanted <= set(read)
    assert len(read) <= len(set(read)) + sum(end - begin for begin, end in ranges) - len(wanted)
    assert len(set(read) - wanted) <= 0.1 * sum(end - begin for begin, end in ranges)


def test_a_batch_takes_addresses_and_evaluates_what_has_changed_there(
    server: WebServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "s.spatial").write_text("spec apart = G (cup dist plate >= 0.1)")
    batch = [
        "batch",
        server.url("drive.mcap"),
        "--spec",
        f"{tmp_path}/s.spatial",
        "-o",
        f"{tmp_path}/results",
    ]
    asked = []
    for _ in range(2):
        assert run(batch) == 0
        asked.append(len(server.asked))
    assert asked[1] - asked[0] <= 1
    del server.files["drive.mcap"]
    assert run(batch) != 0
    assert "there is no such file" in "".join(capsys.readouterr())
