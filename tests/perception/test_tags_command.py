"""`spatial-replay tags`: sheets in true size, and calibrations that give the camera back."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from perception.filmed import TABLE, plate
from spatial_replay.cli import run
from spatial_replay.perception import Frame, parse_tags
from spatial_replay.perception.calibration import TagSheet
from spatial_replay.perception.opencv import Camera, TagDetector, pose_looking_at
from spatial_replay.perception.video import VideoWriter
from spatial_replay.runs.virtual_camera import render

for each in ("av", "cv2", "fpdf"):
    pytest.importorskip(each)

PER_MM = 5


def drawn(pdf: bytes) -> list[np.ndarray]:
    """Return the pages of a sheet as pictures, from the rectangles that a printer would fill."""
    pages = []
    for stream in re.findall(rb"stream\n(.*?)\nendstream", pdf, re.DOTALL):
        try:
            text = zlib.decompress(stream).decode("latin-1")
        except zlib.error:
            continue
        filled = re.findall(r"([-\d.]+) ([-\d.]+) ([-\d.]+) ([-\d.]+) re f\b", text)
        if not filled:
            continue
        page = np.full((297 * PER_MM, 210 * PER_MM), 255, np.uint8)
        for numbers in filled:
            x, y, width, height = (float(each) / 72 * 25.4 * PER_MM for each in numbers)
            rows = sorted(round(page.shape[0] - each) for each in (y, y + height))
            page[rows[0] : rows[1], round(x) : round(x + width)] = 0
        pages.append(page)
    return pages


def test_printed_tags_have_their_size_and_are_where_calibration_takes_them_to_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "tags.pdf"
    assert run(["tags", "print", "--ids", "0-15,40", "--size", "40mm", "-o", str(output)]) == 0
    assert capsys.readouterr().out == f"wrote {output}: 17 tags of 40 mm on 2 pages\n"
    pages = drawn(output.read_bytes())
    found = [TagDetector("36h11").detect(page) for page in pages]
    sheet = TagSheet("36h11", (*range(16), 40), 0.04)
    assert [each.id for page in found for each in page] == [*range(16), 40]
    places = {each.id: each for each in sheet.references()}
    for each in found[0]:
        corners = np.stack([each.corners[:, 0] + 0.5, 297 * PER_MM - 0.5 - each.corners[:, 1]], axis=1)
        # half a millimetre on paper is one in eighty of the tag
        assert np.abs(corners / PER_MM / 1e3 - places[each.id].corners).max() < 3e-4
    again = tmp_path / "again.pdf"
    assert run(["tags", "print", "--ids", "0-15,40", "--size", "40mm", "-o", str(again)]) == 0
    assert again.read_bytes() == output.read_bytes()


@pytest.fixture(scope="module")
def sheet_video(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Camera]:
    """A video of a printed sheet from several sides, and the camera that took it."""
    camera = Camera((620.0, 618.0), (325.0, 236.0), (640, 480), (-0.12, 0.05, 0.0, 0.0))
    path = tmp_path_factory.mktemp("sheet") / "sheet.mp4"
    references = TagSheet("36h11", tuple(range(12)), 0.04).references()
    scene = [plate(each.id, each.x, each.y, 0.0, 0.0, each.size) for each in references]
    eyes = [
        (0.1 + x, 0.17 + y, z)
        for x, y, z in ((0, -0.2, 0.3), (0.2, 0, 0.28), (-0.2, 0.05, 0.3), (0, 0.2, 0.3), (0.15, 0.15, 0.25))
    ]
    eyes += [(x, y, z + 0.12) for x, y, z in eyes]
    with VideoWriter(path, 5) as writer:
        for index, eye in enumerate(eyes):
            pose = pose_looking_at(np.array(eye), np.array([0.1, 0.17, 0.0]), np.array([0.0, 1.0, 0.0]))
            writer.write(Frame(index * 200_000_000, render("36h11", [scene], camera, pose, seed=(index,))))
    return path, camera


def test_a_calibration_gives_the_camera_back_in_the_form_that_tags_files_have(
    sheet_video: tuple[Path, Camera], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, camera = sheet_video
    output = tmp_path / "camera.yaml"
    sheet = ["--ids", "0-11", "--size", "40mm"]
    assert run(["tags", "calibrate", str(video), *sheet, "-o", str(output)]) == 0
    assert re.search(r"\d+ views, corners within 0\.\d+ pixels", capsys.readouterr().out)
    text = "objects: {red: {tag: 0, disc: 1}}\nplane: image\n" + output.read_text()
    measured = parse_tags(text).camera
    assert measured is not None and measured.size == camera.size
    assert np.abs(np.array(measured.focal) - camera.focal).max() < 6.0
    assert np.abs(np.array(measured.centre) - camera.centre).max() < 6.0
    # what counts: where directions go, all over the image
    pixels = np.array([(x, y) for x in (40.0, 320.0, 600.0) for y in (40.0, 240.0, 440.0)])
    off = (measured.directions(pixels) - camera.directions(pixels)) * camera.focal
    assert np.abs(off - off.mean(axis=0)).max() < 3.0


WRONG = {
    "a range": (["print", "--ids", "7-", "--size", "40mm"], "write 0-7 or 0,3,5-9"),
    "too many": (["print", "--ids", "0-99999", "--size", "40mm"], "more than 1000 tags"),
    "no such tag": (["print", "--family", "16h5", "--ids", "30", "--size", "40mm"], "its tags are 0 to 29"),
    "no such family": (["print", "--family", "36h13", "--ids", "0", "--size", "40mm"], "known are 16h5"),
    "too large": (["print", "--ids", "0", "--size", "40cm"], "give a smaller --size"),
    "a tag twice": (["print", "--ids", "0,0,1", "--size", "40mm"], "tag 0 is given more than once"),
    "inches": (["print", "--ids", "0", "--size", "2in"], "write 40mm or 4cm"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_sheet_is_refused_in_words(
    what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, said = WRONG[what]
    assert run(["tags", *arguments, "-o", f"{tmp_path}/tags.pdf"]) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_sheet_under_another_name_than_that_of_a_pdf_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["tags", "print", "--ids", "0", "--size", "40mm", "-o", f"{tmp_path}/tags.png"]) == 2
    assert "give a name that ends in .pdf" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_sheet_that_was_printed_otherwise_gives_no_camera(
    sheet_video: tuple[Path, Camera], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "camera.yaml"
    wrong = ["--ids", "0-11", "--size", "50mm", "-o", str(output)]
    assert run(["tags", "calibrate", str(sheet_video[0]), *wrong]) == 2
    assert "give --family, --ids, --size and --paper as the sheet was printed" in capsys.readouterr().err
    assert not output.exists()


def test_too_few_views_are_refused(
    sheet_video: tuple[Path, Camera], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tags.yaml").write_text(TABLE)
    assert run(["tags", "calibrate", str(sheet_video[0]), "--tags", f"{tmp_path}/tags.yaml"]) == 2
    assert "6 views are needed: tilt the sheet" in capsys.readouterr().err
