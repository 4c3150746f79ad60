"""`spatial-replay tags`: print AprilTags in true size, and calibrate the camera that sees them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import LogPath, output_option
from spatial_replay.cli.terminal import progress, show, show_file, warn
from spatial_replay.errors import OutputError, UsageError
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.text import plural

if TYPE_CHECKING:
    from spatial_replay.perception.opencv import Frame

_MOST = 1000
_LENGTH = re.compile(r"([0-9]*\.?[0-9]+)(mm|cm|m)")
_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def _ids(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[int, ...] | None:
    """Return the numbers in a text such as 0-7,12."""
    if text is None:
        return None
    tag_numbers: list[int] = []
    for range_text in text.split(","):
        first_number, dash, last_number = range_text.strip().partition("-")
        last_number = last_number if dash else first_number
        if not (first_number.isdecimal() and last_number.isdecimal()) or len(first_number + last_number) > 12:
            raise UsageError(f"--ids: {range_text!r} is neither a number nor a range; write 0-7 or 0,3,5-9")
        if int(last_number) - int(first_number) >= _MOST:
            raise UsageError(f"--ids: {range_text!r} names more than {_MOST} tags; print fewer at once")
        tag_numbers += range(int(first_number), int(last_number) + 1)
    return tuple(tag_numbers)


def _size(context: click.Context, parameter: click.Parameter, text: str | None) -> float | None:
    if text is None:
        return None
    match = _LENGTH.fullmatch(text.strip())
    if match is None:
        raise UsageError(f"--size: {text!r} is not a length; write 40mm or 4cm")
    return float(match[1]) * _UNITS[match[2]]


_family = click.option(
    "--family", default="36h11", show_default=True, help="Family of the tags: 16h5, 25h9, 36h10 or 36h11."
)
_paper = click.option(
    "--paper", type=click.Choice(["a4", "a3", "letter"]), default="a4", show_default=True, help="Paper."
)


def _counting(frames: Iterable[Frame], advance: Callable[[int], None]) -> Iterator[Frame]:
    for frame in frames:
        advance(1)
        yield frame


@click.group()
def tags() -> None:
    """Print AprilTags, and calibrate the camera that sees them.

    \b
    Examples:
      spatial-replay tags print --ids 0-7 --size 40mm -o tags.pdf
      spatial-replay tags calibrate sheet.mp4 --ids 0-11 --size 40mm
    """


@tags.command("print")
@_family
@click.option("--ids", required=True, metavar="LIST", callback=_ids, help="Numbers, such as 0-7 or 0,3,5-9.")
@click.option(
    "--size", required=True, metavar="LENGTH", callback=_size, help="Edge of the black square, such as 40mm."
)
@_paper
@output_option("Sheets to write (PDF).", required=True)
def print_tags(family: str, ids: tuple[int, ...], size: float, paper: str, output: Path) -> ExitCode:
    """Write sheets of tags in true size, with a ruler to check the printed size.

    Print at 100 %, not fitted to the page. Leave a white rim around each tag, at least an eighth of its
    width.

    \b
    Examples:
      spatial-replay tags print --ids 0-7 --size 40mm -o tags.pdf
      spatial-replay tags print --family 25h9 --ids 0-34 --size 30mm --paper letter -o tags.pdf
    """
    # imported here so that --help stays fast
    from spatial_replay.perception.calibration import TagSheet

    if output.suffix.lower() != ".pdf":
        raise UsageError(f"-o {output.name}: sheets are written as PDF; give a name that ends in .pdf")
    page_count = TagSheet(family, ids, size, paper).write(output)
    show(f"wrote {output}: {plural(len(ids), 'tag')} of {size * 1e3:g} mm on {plural(page_count, 'page')}")
    return ExitCode.SATISFIED


@tags.command()
@click.argument("source", metavar="VIDEO|LOG", type=LogPath())
@click.option("--topic", metavar="TOPIC", help="Image topic of a log.  [default: the only one]")
@_family
@click.option("--ids", metavar="LIST", callback=_ids, help="Numbers on the sheet, as for `tags print`.")
@click.option("--size", metavar="LENGTH", callback=_size, help="Their size, as for `tags print`.")
@_paper
@click.option(
    "--tags",
    "tags_file",
    metavar="TAGS",
    type=LogPath(),
    help="Tags file whose reference tags are seen, instead of a printed sheet.",
)
@output_option("File for the calibration (YAML).  [default: standard output]")
def calibrate(
    source: LogFile,
    topic: str | None,
    family: str,
    ids: tuple[int, ...] | None,
    size: float | None,
    paper: str,
    tags_file: LogFile | None,
    output: Path | None,
) -> ExitCode:
    """Measure focal length, principal point and lens distortion from a video of tags.

    Film the first page of `tags print`, flat, from near and far, tilted to all sides, up to the corners of
    the image. Or move the camera around a table with reference tags. The result is the `camera` of a tags
    file.

    \b
    Examples:
      spatial-replay tags calibrate sheet.mp4 --ids 0-11 --size 40mm
      spatial-replay tags calibrate around.mp4 --tags tags.yaml -o camera.yaml
    """
    # imported here so that --help stays fast
    from spatial_replay.logs.output_file import refuse_inputs
    from spatial_replay.perception.calibration import TagSheet, calibrate_camera, camera_text
    from spatial_replay.perception.image_sources import open_frames
    from spatial_replay.perception.tags_file import load_tags

    if output is not None:
        refuse_inputs(output, local_files([source, *([tags_file] if tags_file is not None else [])]))
    if tags_file is not None:
        layout = load_tags(tags_file)
        family, references = layout.family, layout.references
        if not references:
            raise UsageError(f"{layout.name} has no reference tags; give --ids and --size of a printed sheet")
    elif ids is None or size is None:
        raise UsageError("give --ids and --size of the printed sheet, or --tags TAGS")
    else:
        references = TagSheet(family, ids, size, paper).references()
    frames = open_frames(source, topic=topic)
    with progress("frames") as advance:
        calibration = calibrate_camera(source.name, _counting(frames, advance), family, references)
    warn(*calibration.remarks, *frames.faults)
    text = camera_text(calibration.calibration.camera)
    if output is None:
        show_file(text)
    else:
        try:
            output.write_text(text, encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{output}: {(error.strerror or str(error)).lower()}") from None
    fx_deviation, fy_deviation, *_ = calibration.calibration.deviations
    rms = calibration.calibration.rms
    show(
        f"{plural(calibration.views, 'view')}, corners within {rms:.2f} pixels; focal lengths to"
        f" {2 * fx_deviation:.1f} and {2 * fy_deviation:.1f} pixels",
        err=output is None,
    )
    return ExitCode.SATISFIED
