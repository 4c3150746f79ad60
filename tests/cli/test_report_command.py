"""`report`: the page is there, and the exit code says what is on it."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

import spatial_replay as sr
from report.report_pages import RECORDINGS, page_of
from spatial_replay import SpecificationError, UsageError
from spatial_replay.cli.application import application


def call(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(application, [str(each) for each in arguments], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return int(result.return_value), result.output


@pytest.mark.parametrize(("spec", "code"), [("table.spatial", 0), ("table_edited.spatial", 1)])
def test_the_exit_code_is_the_verdict(tmp_path: Path, spec: str, code: int) -> None:
    output = tmp_path / "run.html"
    ended, said = call("report", RECORDINGS / "table.jsonl", "--spec", RECORDINGS / spec, "-o", output)
    assert ended == code
    assert f"wrote {output}" in said
    assert ("violated" if code else "satisfied") in page_of(output).within("header#")


def test_a_report_uses_the_specification_of_the_log_by_default(tmp_path: Path) -> None:
    code, _ = call("report", RECORDINGS / "push.mcap", "-o", tmp_path / "run.html")
    assert code == 0
    assert "push.spatial" in page_of(tmp_path / "run.html").within("header#")


def test_a_report_is_named_by_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run.1.mcap").write_bytes((RECORDINGS / "push.mcap").read_bytes())
    monkeypatch.chdir(tmp_path)
    code, said = call("report", "run.1.mcap")
    assert (code, "wrote run.1.html" in said) == (0, True)
    assert "push.spatial" in page_of(tmp_path / "run.1.html").within("header#")


def test_a_report_covers_the_readable_part_of_a_damaged_log(tmp_path: Path) -> None:
    log = tmp_path / "broken.mcap"
    log.write_bytes((RECORDINGS / "push.mcap").read_bytes()[:900_000])
    code, said = call("report", log, "--spec", RECORDINGS / "push.spatial", "-o", tmp_path / "run.html")
    assert code == 3
    assert "damaged" in said
    assert "The log is damaged" in page_of(tmp_path / "run.html").within("header#")


def test_a_report_marks_unknown_results(tmp_path: Path) -> None:
    spec = tmp_path / "s.spatial"
    spec.write_text("spec s = a ovlp b\n")
    with sr.Recorder(tmp_path / "run.mcap", specifications=[sr.load_specification(spec)]) as recorder:
        for t in range(3):
            objects = {"a": sr.Footprint.box(0, 0, 1, 1)} | ({"b": sr.Footprint.disc(0, 0, 1)} if t else {})
            recorder.write(sr.Sample(t * 10**8, objects))
    code, _ = call("report", tmp_path / "run.mcap", "-o", tmp_path / "run.html")
    assert code == 4
    page = page_of(tmp_path / "run.html")
    assert "b is not in the sample" in page.within("section#verdicts")
    assert page.facts["results"][0]["nodes"][0]["value"] == "-inf … inf"


def test_a_report_takes_a_window_and_the_paper_semantics(tmp_path: Path) -> None:
    spec = tmp_path / "s.spatial"
    spec.write_text("spec s = F (cup ovlp plate)\n")
    arguments = (
        "--spec",
        spec,
        "--from",
        "2s",
        "--to",
        "4s",
        "--semantics",
        "paper",
        "-o",
        tmp_path / "run.html",
    )
    code, _ = call("report", RECORDINGS / "table.jsonl", *arguments)
    assert code == 1
    page = page_of(tmp_path / "run.html")
    assert "2.000 s to 3.967 s · 60 samples · semantics paper" in page.within("header#")
    times = page.numbers(page.facts["times"])
    assert (times[0], round(times[-1], 3), len(times)) == (2.0, 3.967, 60)


def test_options_that_cannot_work_leave_no_report(tmp_path: Path) -> None:
    output, log = tmp_path / "run.html", RECORDINGS / "table.jsonl"
    with pytest.raises(UsageError, match="holds no specification of its own"):
        call("report", log, "-o", output)
    spec = tmp_path / "s.spatial"
    spec.write_text("spec s = F (no_such_thing ovlp plate)\n")
    with pytest.raises(SpecificationError):
        call("report", log, "--spec", spec, "--strict-names", "-o", output)
    with pytest.raises(UsageError, match="is an input"):
        call("report", log, "--spec", spec, "-o", spec)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s.spatial"]


def test_a_report_never_takes_the_name_of_a_log(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    log.write_bytes(b"a log that is needed")
    spec = RECORDINGS / "table.spatial"
    with pytest.raises(UsageError, match=r"report writes an HTML page; name it run\.html"):
        call("report", RECORDINGS / "table.jsonl", "--spec", spec, "-o", log)
    assert log.read_bytes() == b"a log that is needed"
