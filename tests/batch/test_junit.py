"""JUnit reports that every reader accepts, and the tolerance of a baseline."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import pyarrow as pa
import pytest
import xmlschema
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from batch.fleet import batch, write_fleet
from examples import examples
from spatial_replay.batch.junit import write_junit
from spatial_replay.batch.run_table import Tolerance
from spatial_replay.batch.store import run_columns

SCHEMA = xmlschema.XMLSchema(Path(__file__).with_name("xunit2.xsd"))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of a suite: violated, damaged and unreadable logs, two cases of the same logs."""
    folder = tmp_path_factory.mktemp("run")
    write_fleet(folder, [0.5, 0.2, 0.1])
    (folder / "logs/broken.jsonl").write_text("{")
    (folder / "suite.yaml").write_text(
        "specs: gate.spatial\ncases:\n  - {name: one, logs: logs}\n  - {name: two, logs: logs, every: 2}\n"
    )
    assert batch(str(folder / "suite.yaml"), "--junit", str(folder / "junit.xml")).code == 3
    return folder


def test_reports_are_valid_and_name_requirements(run: Path) -> None:
    SCHEMA.validate(run / "junit.xml")
    root = ElementTree.parse(run / "junit.xml").getroot()
    assert (root.get("tests"), root.get("failures"), root.get("errors")) == ("16", "4", "4")
    assert [suite.get("name") for suite in root] == ["one.apart", "one.arrives", "two.apart", "two.arrives"]
    requirements = [each.get("value") for each in root.iterfind(".//property[@name='requirement']")]
    assert requirements == ["REQ-3", "REQ-4"] * 2
    cases = [(case.get("classname"), case.get("name")) for case in root.iter("testcase")]
    assert len(set(cases)) == len(cases) == 16
    failure = root.find("testsuite/testcase[@name='logs/run-2.jsonl']/failure")
    assert failure is not None
    assert failure.get("message") == "violated, expected satisfied"
    assert "What decides is `cart dist person >= 0.3`, which fails by 0.2" in (failure.text or "")


def test_a_report_that_would_be_too_large_leaves_out_what_passes(run: Path, tmp_path: Path) -> None:
    table = sr.read_results(run / "suite.results")
    write_junit(tmp_path / "small.xml", table, "suite", largest=4_000)
    SCHEMA.validate(tmp_path / "small.xml")
    root = ElementTree.parse(tmp_path / "small.xml").getroot()
    assert root.get("tests") == "16"
    assert len(list(root.iter("failure"))) + len(list(root.iter("error"))) == 8
    assert len(list(root.iter("testcase"))) == 8
    assert "that passed left out" in (root.findtext("testsuite/system-out") or "")


@given(st.lists(st.text(max_size=20), min_size=6, max_size=6))
@examples(20)
def test_any_name_and_text_makes_a_valid_report(texts: list[str]) -> None:
    log, spec, case, failure, reason, requirement = texts
    row = {
        "key": "0", "log": log, "spec": spec, "case": case, "file": "a.spatial", "line": 1, "seconds": 0.0,
        "failure": failure, "verdict": "violated", "requirement": requirement, "explanation": [reason],
        "vacuous": [],
    }  # fmt: skip
    try:
        table = pa.Table.from_pylist([row], schema=run_columns())
    except UnicodeEncodeError:
        # half a character, which no text of ours holds
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "junit.xml"
        write_junit(path, table, "suite")
        SCHEMA.validate(path)


numbers = st.floats(-1e6, 1e6)


@given(numbers, st.floats(0.0, 1e3), st.floats(0.0, 1e3))
def test_a_tolerance_allows_what_is_better_and_never_what_is_undetermined(
    before: float, share: float, amount: float
) -> None:
    tolerance = Tolerance(share, amount)
    assert tolerance.allows(before, before)
    assert tolerance.allows(before, before + 1.0)
    assert tolerance.allows(before, math.inf)
    assert not tolerance.allows(before, None)
    assert not tolerance.allows(math.inf, before)
    allowed = max(share * abs(before), amount)
    assert tolerance.allows(before, before - 0.999 * allowed)
    assert not tolerance.allows(before, before - allowed - 1.0)
