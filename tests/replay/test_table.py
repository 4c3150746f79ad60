"""Annotated logs as tables."""

from __future__ import annotations

import csv
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from replay.runs import SPECIFICATION, PiecewiseSource, record, run
from spatial_replay import UsageError, parse_specification
from spatial_replay.replay.engine import Replayed, run_replay
from spatial_replay.replay.selection import ReplayOptions, Window
from spatial_replay.replay.table import QUANTITIES, export_table
from spatial_replay.sources import open_source


@pytest.fixture
def annotated(tmp_path: Path) -> tuple[Path, Replayed]:
    path = tmp_path / "annotated.mcap"
    spec = parse_specification(f"{SPECIFICATION}spec near(ego) = G (ego dist cube <= 9)\n")
    replayed = run_replay(
        PiecewiseSource(run(), 5), [spec], ReplayOptions(each={"ego": "all"}), output=path, keep_series=True
    )
    return path, replayed


def _rows(path: Path) -> list[list[str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.reader(stream))


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_table_has_every_number(annotated: tuple[Path, Replayed], tmp_path: Path, quantity: str) -> None:
    path, replayed = annotated
    output = tmp_path / "run.csv"
    rows, columns, faults = export_table(open_source(path), output, quantity=quantity)  # type: ignore[arg-type]
    titles, *body = _rows(output)
    automata = [title for title in titles if title.endswith("/automaton")]
    assert (rows, columns, faults) == (12, len(titles) - 2 - len(automata), ())
    assert len(set(titles)) == len(titles)
    at = QUANTITIES.index(quantity)  # type: ignore[arg-type]
    expected: dict[tuple[int, int], str] = {}
    column = 2
    for result in replayed.results:
        assert result.series is not None
        assert result.times_ns is not None
        for node in range(result.series.shape[0]):
            for time_ns, number in zip(
                result.times_ns.tolist(), result.series[node, at].tolist(), strict=True
            ):
                if number == number:
                    expected[time_ns, column] = repr(number)
            column += 1
    assert expected == {
        (int(row[0]), index): cell
        for row in body
        for index, cell in enumerate(row)
        if 1 < index < columns + 2 and cell
    }


def test_columns_have_the_names_of_nodes(annotated: tuple[Path, Replayed], tmp_path: Path) -> None:
    export_table(open_source(annotated[0]), tmp_path / "run.csv")
    assert _rows(tmp_path / "run.csv")[0] == [
        "time_ns",
        "seconds",
        "reach",
        "reach: cube enclosedin goal",
        "apart",
        'apart: cube dist "cup 物" >= 0.5',
        "near(cube)",
        "near(cube): ego dist cube <= 9",
        "near(cup 物)",
        "near(cup 物): ego dist cube <= 9",
        "reach/automaton",
        "apart/automaton",
        "near(cube)/automaton",
        "near(cup 物)/automaton",
    ]


def test_a_named_part_is_called_after_the_specs_that_it_is_part_of(tmp_path: Path) -> None:
    text = """\
region goal = box(4, -1, 9, 2)
spec grasp = F (cube ovlp goal)
spec deliver = grasp and F (cube enclosedin goal)
spec task = deliver and G (cube dist cube >= 0)
"""
    path = tmp_path / "annotated.mcap"
    run_replay(PiecewiseSource(run(), 5), [parse_specification(text)], output=path)
    export_table(open_source(path), tmp_path / "run.csv")
    titles = _rows(tmp_path / "run.csv")[0]
    assert titles[2:6] == ["task", "task/deliver", "task/deliver/grasp", "task/deliver/grasp: cube ovlp goal"]


def test_seconds_count_from_the_first_sample_of_the_log(tmp_path: Path) -> None:
    path = tmp_path / "late.mcap"
    spec = parse_specification(SPECIFICATION)
    run_replay(PiecewiseSource(run(), 5), [spec], ReplayOptions(Window(start_ns=10**9)), output=path)
    export_table(open_source(path), tmp_path / "run.csv")
    _, *body = _rows(tmp_path / "run.csv")
    first_ns = int(body[0][0])
    assert first_ns == 10**9
    assert [float(row[1]) for row in body] == [int(row[0]) / 1e9 for row in body]


def test_automata_have_a_column_of_states_each(annotated: tuple[Path, Replayed], tmp_path: Path) -> None:
    export_table(open_source(annotated[0]), tmp_path / "run.csv")
    titles, *body = _rows(tmp_path / "run.csv")
    states = [row[titles.index("reach/automaton")] for row in body]
    # the cube enters the goal with sample 8, and has been there ever since
    assert states == ["0"] * 8 + ["1"] * 4
    apart = [row[titles.index("apart/automaton")] for row in body]
    assert "0|1" in apart, "the cup is out of sight in some samples, so that several states are possible"


def test_no_two_columns_have_the_same_name(tmp_path: Path) -> None:
    spec = parse_specification('spec time_ns = F cube ovlp "cup 物"\nspec s = G time_ns\n')
    twin = parse_specification("spec s = F cube ovlp cube", filename="twin.spatial")
    path = tmp_path / "annotated.mcap"
    run_replay(PiecewiseSource(run(), 5), [spec, twin], output=path)
    export_table(open_source(path), tmp_path / "run.csv")
    titles = _rows(tmp_path / "run.csv")[0]
    assert titles[0] == "time_ns"
    assert titles.count("time_ns") == 1
    assert len(set(titles)) == len(titles) > 4


def test_parquet_holds_the_same_numbers(annotated: tuple[Path, Replayed], tmp_path: Path) -> None:
    if find_spec("pyarrow") is None:
        with pytest.raises(UsageError, match="Parquet needs pyarrow; pip install"):
            export_table(open_source(annotated[0]), tmp_path / "run.parquet")
        assert not (tmp_path / "run.parquet").exists()
        return
    parquet = import_module("pyarrow.parquet")
    export_table(open_source(annotated[0]), tmp_path / "run.csv")
    export_table(open_source(annotated[0]), tmp_path / "run.parquet")
    table = parquet.read_table(tmp_path / "run.parquet")
    titles, *body = _rows(tmp_path / "run.csv")
    assert table.column_names == titles
    numeric = len(titles) - 4
    cells = [
        [None if cell == "" else cell if index >= numeric else float(cell) for index, cell in enumerate(row)]
        for row in body
    ]
    assert [list(row) for row in zip(*table.to_pydict().values(), strict=True)] == cells


def test_a_log_without_robustness_is_reported_with_the_remedy(tmp_path: Path) -> None:
    log = record(run(), tmp_path / "run.mcap")
    with pytest.raises(UsageError, match="holds no /spatial/robustness; write it with spatial-replay replay"):
        export_table(open_source(log), tmp_path / "run.csv")
    assert not (tmp_path / "run.csv").exists()


def test_the_ending_of_the_file_gives_the_format(annotated: tuple[Path, Replayed], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"run\.xls ends in neither \.csv nor \.parquet"):
        export_table(open_source(annotated[0]), tmp_path / "run.xls")
