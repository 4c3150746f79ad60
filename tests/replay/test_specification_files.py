"""Specification files that are saved while they are watched, and constants written into them."""

from __future__ import annotations

import stat
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from threading import Event, Thread

import pytest
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from spatial_replay import MissingFileError, SpatialReplayError, SpecificationError, UsageError
from spatial_replay.replay.specification_files import SpecificationFiles, write_constants

TEXT = "const near = 70 in [40, 100]  # pixels\nspec s = F cube dist cup <= near\n"
PATIENCE_S = 60.0

Saves = Iterator[list[sr.Specification] | SpatialReplayError | None]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "s.spatial"
    path.write_text(TEXT)
    return path


def watched(path: Path, **constants: float) -> tuple[SpecificationFiles, Saves]:
    files = SpecificationFiles([path], constants=constants)
    files.load()
    saves = files.iter_saves()
    # the first turn starts the watching
    assert next(saves) is None
    return files, saves


def saved(saves: Saves) -> list[sr.Specification] | SpatialReplayError:
    """What the next save gives."""
    deadline = time.monotonic() + PATIENCE_S
    for each in saves:
        if each is not None:
            return each
        assert time.monotonic() < deadline
    raise AssertionError("the watching ended")


def near(outcome: list[sr.Specification] | SpatialReplayError) -> float:
    assert isinstance(outcome, list)
    return outcome[0].constants["near"].value


def test_saving_in_place_and_by_renaming_gives_the_new_text(path: Path) -> None:
    _, saves = watched(path)
    path.write_text(TEXT.replace("70", "80"))
    assert near(saved(saves)) == 80
    other = path.with_name("s.spatial~")
    other.write_text(TEXT.replace("70", "90"))
    other.replace(path)
    assert near(saved(saves)) == 90
    path.write_text(TEXT.replace("70", "60"))
    assert near(saved(saves)) == 60


def test_an_error_is_given_once_and_the_next_good_text_after_it(path: Path) -> None:
    _, saves = watched(path)
    path.write_text(TEXT.replace("dist", "dits"))
    error = saved(saves)
    assert isinstance(error, SpecificationError)
    assert "did you mean 'dist'" in str(error)
    assert [next(saves) for _ in range(3)] == [None] * 3
    path.write_text(TEXT)
    assert near(saved(saves)) == 70


def test_a_file_that_is_deleted_is_an_error_until_it_is_back(path: Path) -> None:
    _, saves = watched(path)
    path.unlink()
    assert isinstance(saved(saves), MissingFileError)
    path.write_text(TEXT.replace("70", "80"))
    assert near(saved(saves)) == 80


def written_in_parts(path: Path, parts: list[str]) -> list[sr.Specification] | SpatialReplayError:
    """What a watch gives of a file while another thread writes it, a part every hundredth of a second.

    A busy machine may keep that thread from running for longer than a watch waits, after which half of a
    file is as good as a whole one; then it is written once more.
    """
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        path.write_text(TEXT)
        _, saves = watched(path)
        moments = [time.monotonic()]

        def write(moments: list[float] = moments) -> None:
            moments[0] = time.monotonic()
            with path.open("w") as file:
                for part in parts:
                    time.sleep(0.01)
                    file.write(part)
                    file.flush()
                    moments.append(time.monotonic())

        writing = Thread(target=write)
        writing.start()
        outcome = saved(saves)
        writing.join()
        if max(after - before for before, after in pairwise(moments)) < 0.025:
            return outcome
    raise AssertionError("this machine is too busy to write a file without interruption")


def test_a_file_caught_while_it_is_written_is_read_when_it_is_whole(path: Path) -> None:
    text = TEXT.replace("70", "80")
    parts = [text[begin : begin + 12] for begin in range(0, len(text), 12)]
    assert near(written_in_parts(path, parts)) == 80


def test_half_of_a_file_is_not_taken_for_a_save_although_it_parses(path: Path) -> None:
    begin = TEXT.replace("70", "80") + "spec t = G cube dist cup <= near\n"
    outcome = written_in_parts(path, [begin, "spec u = F cube dist cup <= near\n"])
    assert isinstance(outcome, list)
    assert [spec.name for spec in outcome[0].specs] == ["s", "t", "u"]


def test_a_file_that_is_written_all_the_time_keeps_no_one_else_waiting(path: Path) -> None:
    _, saves = watched(path)
    has_turned = Event()
    deadline = time.monotonic() + PATIENCE_S

    def write_on_and_on() -> None:
        number = 0
        while not has_turned.wait(0.005) and time.monotonic() < deadline:
            number += 1
            path.write_text(TEXT.replace("pixels", f"pixels {number}").replace("70", "80"))

    writing = Thread(target=write_on_and_on)
    writing.start()
    # what they give is open: this thread may be kept from running until one text has stayed long enough
    next(saves)
    next(saves)
    assert writing.is_alive() and time.monotonic() < deadline
    has_turned.set()
    writing.join()
    path.write_text(TEXT.replace("70", "90"))
    assert near(saved(saves)) == 90


def test_what_the_command_line_gives_stands_until_it_is_written(path: Path) -> None:
    files, saves = watched(path, near=50.0)
    path.write_text(TEXT.replace("pixels", "in pixels").replace("70", "80"))
    assert near(saved(saves)) == 50
    assert files.write() == {"near": 50.0}
    assert path.read_text() == TEXT.replace("pixels", "in pixels").replace("70", "50")
    path.write_text(TEXT.replace("70", "90"))
    assert near(saved(saves)) == 90


def test_without_a_file_there_is_nothing_to_watch() -> None:
    with pytest.raises(UsageError, match="give --spec FILE"):
        SpecificationFiles([])


NUMBERS = st.integers(40, 100).map(float)
COMMENTS = st.text(
    st.characters(codec="utf-8", exclude_characters="\r\n", exclude_categories=["Cc", "Cs", "Zl", "Zp"]),
    max_size=12,
)


@examples(30)
@given(
    NUMBERS,
    NUMBERS,
    COMMENTS,
    st.sampled_from(["\n", "\r\n"]),
    st.booleans(),
    st.sampled_from(["", " ", "  "]),
)
def test_writing_changes_the_numbers_alone(
    tmp_path_factory: pytest.TempPathFactory,
    before: float,
    after: float,
    comment: str,
    end: str,
    has_mark: bool,
    blanks: str,
) -> None:
    path = tmp_path_factory.mktemp("written") / "s.spatial"

    def content(number: float) -> bytes:
        lines = [
            f"# {comment} 70",
            f"const near{blanks}={blanks}{number:g}{blanks} in [40, 100]  # {comment}",
            "",
            "const far = near * 2",
            "spec s = F cube dist cup <= far",
            "",
        ]
        return (b"\xef\xbb\xbf" if has_mark else b"") + end.join(lines).encode()

    path.write_bytes(content(before))
    path.chmod(0o640)
    assert write_constants(path, {"near": after}) == (("near",) if after != before else ())
    assert path.read_bytes() == content(after)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


@pytest.mark.parametrize(
    ("values", "error", "said"),
    [
        ({"naer": 50.0}, UsageError, "did you mean 'near'"),
        ({"near": 300.0}, SpecificationError, "300 is outside of the range"),
        ({"near": "2s"}, UsageError, "it is a number"),
    ],
)
def test_values_that_do_not_fit_leave_the_file_as_it_is(
    path: Path, values: dict[str, float | str], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        write_constants(path, values)
    assert path.read_text() == TEXT
