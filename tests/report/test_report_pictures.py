"""The report shows what a log's camera saw, in small pictures that do not make the page large."""

from __future__ import annotations

import base64
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from perception.filmed import write_approach
from report.report_pages import page_of
from spatial_replay.cli import run

pytest.importorskip("av")
pytest.importorskip("cv2")

COUNT = 12
SECONDS = [0.04 * index for index in range(COUNT)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log of a filmed table, and its report."""
    folder = tmp_path_factory.mktemp("filmed")
    write_approach(folder, COUNT)
    arguments = ["--tags", f"{folder}/tags.yaml", "--spec", f"{folder}/apart.spatial"]
    assert run(["record", "video", f"{folder}/table.mp4", *arguments, "-o", f"{folder}/run.mcap"]) == 1
    assert run(["report", f"{folder}/run.mcap", "-o", f"{folder}/run.html"]) == 1
    return folder


def test_the_page_has_every_picture_of_a_short_run_at_its_time(folder: Path) -> None:
    import cv2

    from spatial_replay.perception import open_frames

    page = page_of(folder / "run.html")
    camera = page.facts["camera"]
    assert (camera["topic"], camera["reason"]) == ("/camera/video", "")
    assert camera["times"] == pytest.approx(SECONDS)
    for frame, uri in zip(open_frames(folder / "table.mp4"), camera["pictures"], strict=True):
        data = base64.b64decode(uri.removeprefix("data:image/jpeg;base64,"))
        small = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert small.shape == (240, 320, 3)
        there = cv2.resize(frame.image, (320, 240), interpolation=cv2.INTER_AREA)
        assert np.abs(small.astype(float) - there).mean() < 4
    # the browser may show what is in the page, and loads nothing
    assert "default-src 'none'" in page.text and "img-src data:;" in page.text


def test_pictures_of_a_long_and_noisy_video_are_few_and_small_and_equal_logs_give_equal_pages(
    tmp_path: Path,
) -> None:
    from spatial_replay.perception import Frame, open_frames
    from spatial_replay.perception.video import VideoWriter

    write_approach(tmp_path, 2)
    still = next(frame.image for frame in open_frames(tmp_path / "table.mp4"))
    noise = np.random.default_rng(1)
    with VideoWriter(tmp_path / "noisy.mkv", 25) as writer:
        for index in range(90):
            speckled = still.copy()
            speckled[:, ::2] = noise.integers(0, 256, speckled[:, ::2].shape)
            image = speckled if index % 3 else still
            writer.write(Frame(index * 40_000_000, image))
    tags = ["--tags", f"{tmp_path}/tags.yaml", "--spec", f"{tmp_path}/apart.spatial"]
    run(["record", "video", f"{tmp_path}/noisy.mkv", *tags, "-o", f"{tmp_path}/noisy.mcap"])
    for name in ("one", "two"):
        run(["report", f"{tmp_path}/noisy.mcap", "-o", f"{tmp_path}/{name}.html"])
    camera = page_of(tmp_path / "one.html").facts["camera"]
    assert 50 <= len(camera["times"]) <= 60 and camera["times"] == sorted(set(camera["times"]))
    assert sum(map(len, camera["pictures"])) <= 1_500_000
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "two.html").read_bytes()


def test_without_the_extra_the_page_says_so_in_a_line(folder: Path) -> None:
    program = (
        "import sys; sys.modules['av'] = None\n"
        "from spatial_replay.cli import run\n"
        f"sys.exit(run(['report', {f'{folder}/run.mcap'!r}, '-o', {f'{folder}/bare.html'!r}]))"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True).returncode == 1
    camera = page_of(folder / "bare.html").facts["camera"]
    assert camera["pictures"] == []
    assert camera["reason"] == (
        "The pictures of /camera/video are not shown: videos need PyAV, which is not installed: "
        "pip install 'spatial-replay[vision]'."
    )


def test_a_log_without_a_camera_has_no_such_panel(tmp_path: Path) -> None:
    (tmp_path / "a.jsonl").write_text(
        '{"time_ns": 0, "objects": [{"name": "a", "polygon": [[0, 0], [1, 0], [0, 1]]}]}\n'
    )
    (tmp_path / "a.spatial").write_text("spec s = F (a ovlp a)\n")
    run(["report", f"{tmp_path}/a.jsonl", "--spec", f"{tmp_path}/a.spatial", "-o", f"{tmp_path}/a.html"])
    assert 'id="camera"' not in (tmp_path / "a.html").read_text("utf-8")
