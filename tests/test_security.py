"""The limits that SECURITY.md states are those of the code."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from importlib import import_module
from pathlib import Path

import pytest
from mcap.writer import Writer

import spatial_replay as sr
from cli.program import run_program
from report.report_pages import page_of
from spatial_replay.logs.topics import RECORDED_PREFIX

TEXT = (Path(__file__).parents[1] / "SECURITY.md").read_text()
ROW = re.compile(
    r"^\| (?P<what>.+) \| (?P<limit>\d+)(?: (?P<unit>KiB|MiB|GiB|s))? "
    r"\| `(?P<file>\S+)\.py` `(?P<name>\w+)` \|$"
)
UNITS = {"": 1, "s": 1, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


def rows() -> list[tuple[str, str, str, int]]:
    section = TEXT.split("## Limits")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")][1:]
    found = [ROW.match(line) for line in lines]
    assert all(found), [line for line, match in zip(lines, found, strict=True) if not match]
    return [
        (match["what"], match["file"], match["name"], int(match["limit"]) * UNITS[match["unit"] or ""])
        for match in found
        if match
    ]


def test_every_limit_is_the_one_of_the_code() -> None:
    wrong = []
    for what, file, name, limit in rows():
        module = import_module(f"spatial_replay.{file.replace('/', '.')}")
        if getattr(module, name) != limit:
            wrong.append((what, limit, getattr(module, name)))
    assert not wrong
    assert len(rows()) > 30


def test_a_crowd_beyond_a_limit_is_refused() -> None:
    crowd = {f"o{number}": sr.Footprint.disc(number, 0, 0.1) for number in range(20_001)}
    monitor = sr.Monitor(sr.parse_specification("G (forall x, y in all: x dist y >= 0.5)"))
    with pytest.raises(sr.UsageError, match="closest two of 20001 objects; 20000 is the limit"):
        monitor.update(sr.Sample(0, crowd))
    with pytest.raises(sr.TraceError, match="there are 20,001 objects; 20,000 is the limit"):
        sr.Trace.from_samples([sr.Sample(0, crowd)])


@pytest.mark.parametrize("command", ["replay", "report", "explain", "info"])
def test_a_log_of_too_many_signals_is_refused(tmp_path: Path, command: str) -> None:
    signals = {f"s{number}": number for number in range(20_001)}
    (tmp_path / "run.jsonl").write_text(json.dumps({"time_ns": 0, "objects": [], "signals": signals}))
    (tmp_path / "s.spatial").write_text("spec ready = G (s1 >= 0)")
    spec = ["--spec", "s.spatial"] if command != "info" else []
    done = run_program(command, "run.jsonl", *spec, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (3, "")
    assert "error: there are 20,001 signals; 20,000 is the limit: leave some out" in done.stderr


@pytest.mark.parametrize(
    "text",
    [
        "G (a ovlp b) " + "#" * 2**18,
        "not " * 101 + "a ovlp b",
        " and ".join(["a ovlp b"] * 20_001),
        "(" * 10_000,
    ],
    ids=["length", "depth", "size", "brackets"],
)
def test_a_specification_beyond_a_limit_is_refused(text: str) -> None:
    with pytest.raises(sr.SpecificationError):
        sr.parse_specification(text)


def test_names_in_a_log_become_neither_paths_nor_parts_of_a_page(tmp_path: Path) -> None:
    folder, script = tmp_path / "here" / "there", "<script>alert(1)</script>"
    folder.mkdir(parents=True)
    topics = {name: f"/{name}{script}" for name in "ab"}
    with (folder / "run.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic in topics.values():
            channel = writer.register_channel(topic, "json", 0)
            writer.add_message(channel, 1, b'{"x": 1, "y": 2}', 1)
        image = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        camera = writer.register_channel(f"/camera{script}", "json", image)
        picture = {"format": f"jpeg{script}", "data": b64encode(script.encode()).decode()}
        writer.add_message(camera, 1, json.dumps(picture).encode(), 1)
        for number, name in enumerate(["../../out", f"{tmp_path}/out", "../out", f"../{script}"]):
            text = f"spec s{number} = G (a dist b >= 1)"
            for prefix in ("", RECORDED_PREFIX):
                writer.add_attachment(1, 1, f"{prefix}{name}.spatial", "text/plain", text.encode())
        writer.add_metadata("../../out", {"../../out": script})
        writer.finish()
    shape = f"{{position: [x, y], shape: {{disc: 0.1}}, class: '{script}'}}"
    mapped = "".join(f"  '{topic}': {shape[:-1]}, name: {name}}}\n" for name, topic in topics.items())
    (folder / "m.yaml").write_text(f"sample: {{topic: '{topics['b']}'}}\ntopics:\n{mapped}")
    for command in (
        "replay run.mcap --mapping m.yaml -o annotated.mcap",
        "recover run.mcap -o recovered.mcap",
        "info run.mcap --specification -o s.spatial",
        "report run.mcap --mapping m.yaml -o run.html",
        "batch run.mcap --mapping m.yaml --spec s.spatial --jobs 1 --html pages",
    ):
        done = run_program(*command.split(), cwd=folder)
        assert done.returncode in (0, 1), done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["here"]
    assert [path.name for path in (tmp_path / "here").iterdir()] == ["there"]
    pages = [folder / "run.html", *(folder / "pages").rglob("*.html")]
    assert len(pages) == 3
    assert not [page for page in pages if script in page.read_text()]
    assert f"/camera{script}" in page_of(folder / "run.html").facts["camera"]["reason"]
