"""`spatial-replay record`: turn a run, from a file or from a simulated world, into a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypedDict, TypeVar

import click

from spatial_replay.cli.application import ExitCode, exit_code_from_verdicts
from spatial_replay.cli.options import (
    LogPath,
    add_options,
    constants_option,
    durability_option,
    gather,
    input_files,
    load_spec_options,
    log_output_option,
    naming_option,
    overwrite_option,
    reading_options,
    refuse_values,
    specs_option,
    warn_of_input,
)
from spatial_replay.cli.output import change_line, ending_lines
from spatial_replay.cli.terminal import progress, show, show_diagnostics, warn
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.spec import check_names
from spatial_replay.text import listing, nearest_hint, plural
from spatial_replay.trace.trace import duration_ns_from_text

if TYPE_CHECKING:
    from spatial_replay.logs.output_file import Durability
    from spatial_replay.logs.read_options import Reading
    from spatial_replay.recording.log import VerdictChange
    from spatial_replay.runs.record_video import FrameSource, KeepVideo
    from spatial_replay.simulation.world import Injection, Start

_Command = TypeVar("_Command", bound=Callable[..., Any])


def duration_ns(context: click.Context, parameter: click.Parameter, text: str | None) -> int | None:
    """Return the duration in an option's text, in nanoseconds."""
    if text is None:
        return None
    with naming_option(parameter.opts[0]):
        return duration_ns_from_text(text)


@click.command()
@click.argument("sources", metavar="[FILE|LOG]...", type=LogPath(), nargs=-1)
@click.option("--camera", metavar="N", type=click.IntRange(0), help="Camera of this machine, such as 0.")
@click.option(
    "--topic",
    "topics",
    metavar="TOPIC",
    multiple=True,
    help="Topic of a log with images or AprilTag detections; repeat for several cameras.  [default: the"
    " only one]",
)
@click.option(
    "--offset",
    "offsets",
    metavar="NAME=T",
    multiple=True,
    help="With several cameras: shift of one camera's stamps, by name (right.mp4=0.12s) or number (2=-40ms).",
)
@click.option(
    "--tags",
    "tags_file",
    metavar="TAGS",
    type=LogPath(),
    required=True,
    help="Tags file (YAML): the tags of each object, and the plane.",
)
@log_output_option("Log to write (MCAP).")
@overwrite_option
@durability_option
@specs_option("Specification to evaluate while recording; repeat for several.")
@constants_option
@click.option(
    "--keep-video",
    "keep",
    type=click.Choice(["copy", "h264", "none"]),
    help="Copy the pictures, encode them as H.264, or leave them out."
    "  [default: copy where possible, else h264]",
)
@click.option(
    "--hold-hidden",
    "hold_ns",
    metavar="T",
    callback=duration_ns,
    help="Keep a hidden object at its last place for this long, such as 200ms, with growing uncertainty."
    "  [default: 'hold' in the tags file, else 0s]",
)
@click.option(
    "--rate",
    metavar="HZ",
    type=float,
    help="Frame rate for the times of a video, instead of its stamps.",
)
@click.option(
    "--for", "length_ns", metavar="T", callback=duration_ns, help="Duration of a recording from a camera."
)
def video(
    sources: tuple[LogFile, ...],
    camera: int | None,
    topics: tuple[str, ...],
    offsets: tuple[str, ...],
    tags_file: LogFile,
    output: Path,
    overwrite: bool,
    durability: Durability,
    specs: tuple[LogFile, ...],
    constants: Mapping[str, float | str],
    keep: KeepVideo | None,
    hold_ns: int | None,
    rate: float | None,
    length_ns: int | None,
) -> int:
    """Record the tagged objects that a camera saw, with verdicts as they change.

    Reads a video file, a topic of a log with images or AprilTag detections, or a camera of this machine.
    The tags file lists the AprilTags on the objects. Every footprint has an uncertainty. A verdict near a
    threshold is therefore unknown. Several videos or topics are several cameras of the same scene: frames
    of equal time make one sample. Needs the extra `vision`.

    Exits with 0 if all specifications are satisfied, 1 if any is violated, 4 if none is violated and any is
    unknown. It exits with 3 if the video is damaged; the recording before the damage is complete.

    \b
    Examples:
      spatial-replay record video table.mp4 --tags tags.yaml --spec table.spatial -o run.mcap
      spatial-replay record video left.mp4 right.mp4 --tags tags.yaml -o run.mcap --offset 2=0.12s
      spatial-replay record video drive.bag --topic /camera/image_raw --tags tags.yaml -o run.mcap
      spatial-replay record video --camera 0 --tags tags.yaml -o run.mcap --for 60s
    """
    # imported here so that --help stays fast
    from spatial_replay.logs.output_file import refuse_existing
    from spatial_replay.perception.observer import camera_names
    from spatial_replay.perception.tags_file import load_tags
    from spatial_replay.runs.record_video import record_cameras

    if bool(sources) == (camera is not None):
        raise UsageError("give either videos or a log, or --camera N")
    if length_ns is not None and camera is None:
        raise UsageError("--for ends a run with --camera; leave it out")
    if camera is not None and not overwrite:
        refuse_existing(output)
    files = load_spec_options(specs, constants)
    show_diagnostics(warning for file in files for warning in file.warnings)
    tags = load_tags(tags_file)
    names = [tagged.name for tagged in tags.objects]
    unknown_names = [
        diagnosis for file in files for diagnosis in check_names(file, names, (), where="tags file")
    ]
    show_diagnostics(replace(diagnosis, severity="warning") for diagnosis in unknown_names)
    cameras = _open_cameras(sources, camera, topics, rate, length_ns)
    offsets_ns = _offsets_ns(offsets, camera_names(cameras))
    first_times_ns: list[int] = []

    def show_change(change: VerdictChange) -> None:
        show(change_line(change, first_times_ns[0] if first_times_ns else change.time_ns))

    inputs = [*sources, tags_file, *specs]
    with progress("frames") as advance:
        recording = record_cameras(
            cameras,
            tags,
            output,
            files,
            offsets_ns=offsets_ns,
            hold_ns=hold_ns,
            keep=keep,
            inputs=local_files(inputs),
            begin=first_times_ns.append,
            show=show_change,
            advance=advance,
            durability=durability,
        )
    warn(*recording.remarks, *recording.faults)
    show(f"wrote {output}: {plural(recording.samples, 'sample')} over {recording.seconds:.3f} s")
    for name, fit in recording.fits:
        if fit is not None:
            tag_number, error_px = fit.worst
            camera_text = f" in {name}" if len(recording.fits) > 1 else ""
            fit_text = f"reference tags fit within {fit.rms:.2f} pixels{camera_text}"
            show(f"{fit_text}; tag {tag_number} is off most, by {error_px:.2f}")
    show(*ending_lines(recording.endings))
    verdicts = [str(ending.verdict) for ending in recording.endings]
    return exit_code_from_verdicts(verdicts or ["satisfied"], damaged=bool(recording.faults))


def _open_cameras(
    sources: Sequence[LogFile],
    camera: int | None,
    topics: Sequence[str],
    rate: float | None,
    length_ns: int | None,
) -> list[FrameSource]:
    from spatial_replay.perception.image_sources import CameraFrames, open_frames

    if camera is None:
        if len(sources) > 1 and topics:
            raise UsageError(
                "--topic names topics of one log; give that log alone, or videos without --topic"
            )
        if len(set(topics)) < len(topics) or len({str(source) for source in sources}) < len(sources):
            raise UsageError("a video or topic is given twice; each camera counts once")
        topic_names: list[str | None] = [*topics] or [None] * len(sources)
        topic_sources = [*sources] * len(topics) if topics else sources
        return [
            open_frames(source, topic=topic, rate=rate)
            for source, topic in zip(topic_sources, topic_names, strict=True)
        ]
    refuse_values({"--topic": topics, "--rate": rate is not None}, "does not apply to a camera; leave it out")
    return [CameraFrames(camera, length_ns=length_ns)]


def _offsets_ns(texts: Sequence[str], names: Sequence[str]) -> list[int]:
    """Return the offset of each camera's stamps, ns.

    All offsets are raised by the same time, so that none is negative.
    """
    offsets_ns = [0] * len(names)
    for text in texts:
        name, _, duration_text = text.rpartition("=")
        numbers = [
            number for number, camera_name in enumerate(names, 1) if name in (camera_name, str(number))
        ]
        if len(numbers) != 1:
            cameras = ", ".join(f"{number} ({camera_name})" for number, camera_name in enumerate(names, 1))
            fault = "is no camera" if not numbers else "is the name of several cameras"
            raise UsageError(
                f"--offset {text}: {name or text!r} {fault}; write the number and a time: {cameras}"
            )
        with naming_option("--offset"):
            shift_ns = duration_ns_from_text(duration_text.removeprefix("-"))
        offsets_ns[numbers[0] - 1] = -shift_ns if duration_text.startswith("-") else shift_ns
    return [offset_ns - min(0, *offsets_ns) for offset_ns in offsets_ns]


SCENARIOS: Final = ("push", "pick-place", "table-setting")
"""The simulated worlds."""


def _injections(
    context: click.Context, parameter: click.Parameter, texts: tuple[str, ...]
) -> list[Injection]:
    # imported here so that --help stays fast
    from spatial_replay.simulation.world import Injection

    return [Injection.parse(text) for text in texts]


def _starts(context: click.Context, parameter: click.Parameter, texts: tuple[str, ...]) -> list[Start]:
    from spatial_replay.simulation.world import Start

    starts = [Start.parse(text) for text in texts]
    names = [start.name for start in starts]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"--start: {name!r} is given twice; give one place")
    return starts


_SIMULATION = (
    click.option(
        "--seed",
        metavar="N",
        type=click.IntRange(0),
        default=0,
        help="Seed of initial poses and noise.  [default: 0]",
    ),
    click.option(
        "--noise",
        "noise_m",
        metavar="METRES",
        type=click.FloatRange(0),
        default=0.0,
        help="Detection error, also recorded as uncertainty.  [default: 0]",
    ),
    click.option(
        "--inject",
        "injections",
        metavar="MISHAP",
        multiple=True,
        callback=_injections,
        help="Mishap: drop@7s, slip@7s, or slip throughout; repeat for several.",
    ),
    click.option(
        "--start",
        "starts",
        metavar="NAME=X,Y[,TURN]",
        multiple=True,
        callback=_starts,
        help="Initial place of an object, in metres and radians; repeat for several.",
    ),
    click.option("--gui", is_flag=True, help="Show the world in a window, no faster than real time."),
    click.option(
        "--camera",
        "cameras",
        metavar="VIDEO",
        multiple=True,
        type=click.Path(path_type=Path),
        help="Film the run with AprilTags on the objects, and write a tags file next to the video. A second"
        " video is from the other side. Needs the extra `vision`.",
    ),
)


class SimulationArguments(TypedDict):
    """Options of a simulated world."""

    seed: int
    noise_m: float
    injections: list[Injection]
    starts: list[Start]
    gui: bool
    cameras: tuple[Path, ...]


def simulation_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a simulated world. The command receives them as `simulation`."""
    return add_options(_SIMULATION, gather("simulation", SimulationArguments, command))


def show_film(videos: Sequence[Path]) -> None:
    """Print the command that reads the videos of a run, if there are any."""
    if videos:
        from spatial_replay.runs.virtual_camera import tags_of_film

        names = " ".join(str(video) for video in videos)
        tags_file = tags_of_film(videos)
        show(f"filmed {names}: spatial-replay record video {names} --tags {tags_file} -o seen.mcap")


class RecordGroup(click.Group):
    """`record SCENARIO`, and commands that record other sources."""

    allow_extra_args = False
    allow_interspersed_args = True

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args and args[0] in self.commands:
            ctx.args = args
            return args
        if args and args[0] not in SCENARIOS and not args[0].startswith("-") and not ctx.resilient_parsing:
            hint = (
                nearest_hint(args[0], [*SCENARIOS, *self.commands]) or "`record tracks FILE` records a file"
            )
            ctx.fail(f"no scenario is named {args[0]!r}; {hint}")
        return click.Command.parse_args(self, ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        if not ctx.args:
            return click.Command.invoke(self, ctx)
        name, *arguments = ctx.args
        # the new context is a sibling of this context, because the usage of a child would name SCENARIO, too
        path = f"{ctx.info_name} {name}"
        with self.commands[name].make_context(path, arguments, parent=ctx.parent) as context:
            return context.command.invoke(context)

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        return click.Command.collect_usage_pieces(self, ctx)


def scenario_argument(*, required: bool, others: Sequence[str] = ()) -> Callable[[_Command], _Command]:
    """Return the argument SCENARIO.

    Args:
        required: whether the command needs a scenario.
        others: commands that completion offers instead of a scenario.
    """

    def complete(context: click.Context, parameter: click.Parameter, prefix: str) -> list[str]:
        return [name for name in (*SCENARIOS, *others) if name.startswith(prefix)]

    return click.argument(
        "scenario",
        metavar="SCENARIO",
        type=click.Choice(list(SCENARIOS)),
        required=required,
        shell_complete=complete,
    )


@click.group(cls=RecordGroup)
@scenario_argument(required=True, others=("tracks", "video"))
@log_output_option("Log to write (MCAP).")
@durability_option
@specs_option("Specification to evaluate while recording; repeat for several.  [default: the scenario's own]")
@constants_option
@click.option(
    "--duration",
    "length_ns",
    metavar="T",
    callback=duration_ns,
    help="Simulated time, such as 10s.  [default: to the end of the script]",
)
@simulation_options
def record(
    scenario: str,
    output: Path,
    durability: Durability,
    specs: tuple[LogFile, ...],
    constants: Mapping[str, float | str],
    length_ns: int | None,
    simulation: SimulationArguments,
) -> int:
    """Record a run of a simulated world as a log (MCAP); the commands below record other sources.

    A robot follows a script. In push it pushes three blocks, in pick-place it picks and places nine things,
    and in table-setting it sets a table. Equal options give an equal log, byte for byte. Needs
    the extra `sim`.

    \b
    Examples:
      spatial-replay record push -o run.mcap --seed 3 --duration 10s
      spatial-replay record pick-place -o run.mcap --noise 0.002 --inject drop@7s
      spatial-replay record tracks blocks.jsonl.gz -o run.mcap
      spatial-replay record video table.mp4 --tags tags.yaml -o run.mcap
    """
    # imported here so that --help stays fast
    from spatial_replay.runs.scripted import record_script
    from spatial_replay.simulation.tabletop import default_specification

    files = load_spec_options(specs, constants, lambda: default_specification(scenario))
    with progress("samples") as advance:
        recorded = record_script(
            scenario,
            output,
            files or None,
            duration_ns=length_ns,
            inputs=local_files(specs),
            advance=advance,
            durability=durability,
            **simulation,
        )
    show(
        f"wrote {output}: {plural(recorded.samples, 'sample')} over {recorded.seconds:.3f} s of "
        f"{plural(len(recorded.objects), 'object')}: {', '.join(recorded.objects)}"
    )
    show(f"the robot: {recorded.outcome}")
    show_film(simulation["cameras"])
    return ExitCode.SATISFIED


record.add_command(video)


@record.command()
@click.argument("file", type=LogPath())
@log_output_option("Log to write (MCAP).")
@durability_option
@specs_option("Specification to evaluate while recording; repeat for several.")
@constants_option
@reading_options
@click.option(
    "--unit",
    metavar="UNIT",
    default="",
    help="Unit of lengths, for sentences, axes and viewers: m, px.  [default: what the file declares]",
)
def tracks(
    file: LogFile,
    output: Path,
    durability: Durability,
    specs: tuple[LogFile, ...],
    constants: Mapping[str, float | str],
    reading: Reading,
    unit: str,
) -> int:
    """Record the objects of any readable log: tracks, annotations, scenarios, bags with a mapping.

    Parts of the file that cannot be read are reported and left out; the exit code is then 3.

    \b
    Examples:
      spatial-replay record tracks blocks.jsonl.gz -o run.mcap
      spatial-replay record tracks people.csv -o run.mcap --spec social.spatial --unit m
      spatial-replay record tracks annotations.txt -o run.mcap --read lost=keep
    """
    # imported here so that --help stays fast
    from spatial_replay.recording.source_recording import record_source
    from spatial_replay.sources.open_log import open_source

    inputs = input_files(file, *specs, reading=reading)
    source = open_source(file, **reading)
    files = load_spec_options(specs, constants)
    with progress("samples") as advance:
        recorded = record_source(
            source, output, files, inputs=inputs, unit=unit, advance=advance, durability=durability
        )
    warn_of_input(recorded)
    length_s = (recorded.end_ns - recorded.start_ns) / 1e9
    show(
        f"wrote {output}: {plural(recorded.samples, 'sample')} over {length_s:.3f} s of "
        f"{plural(len(recorded.objects), 'object')}: {listing(recorded.objects)}"
    )
    return ExitCode.DAMAGED if recorded.faults else ExitCode.SATISFIED
