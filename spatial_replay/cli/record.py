"""`spatial-replay record`: turn a run, from a file or from a simulated world, into a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypedDict

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    LogPath,
    ReadArguments,
    add_options,
    constants_option,
    durability_option,
    gather,
    input_files,
    load_spec_options,
    log_output_option,
    profile_option,
    reading_options,
    specs_option,
    warn_of_input,
)
from spatial_replay.cli.progress import progress
from spatial_replay.cli.record_video import video
from spatial_replay.cli.terminal import show
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.text import counted
from spatial_replay.trace.time_points import duration_ns_from_text

if TYPE_CHECKING:
    from spatial_replay.logs.output_file import Durability
    from spatial_replay.simulation.world import Injection, Start

SCENARIOS: Mapping[str, str] = MappingProxyType(
    {
        "push": "three blocks on a table, and a robot that pushes them",
        "pick-place": "nine things on a table, and a robot that picks and places them",
        "table-setting": "cutlery, a cup and a plate, and a robot that sets the table",
    }
)
"""The simulated worlds, with a description of each."""

_SIMULATION = (
    click.option(
        "--seed",
        type=click.IntRange(0),
        default=0,
        help="Seed of initial poses and noise.  [default: 0]",
    ),
    click.option(
        "--noise",
        metavar="METRES",
        type=click.FloatRange(0),
        default=0.0,
        help="Detection error, also recorded as uncertainty.  [default: 0]",
    ),
    click.option(
        "--inject",
        metavar="MISHAP",
        multiple=True,
        help="Mishap to inject: drop@7s, slip@7s, or slip for the whole run; repeat for several.",
    ),
    click.option(
        "--start",
        metavar="NAME=X,Y[,TURN]",
        multiple=True,
        help="Where an object is at the beginning, in metres and radians; repeat for several."
        "  [default: as the seed has it]",
    ),
    click.option(
        "--gui",
        is_flag=True,
        help="Show the world in a window, no faster than real time. Needs a display.",
    ),
    click.option(
        "--camera",
        "cameras",
        metavar="VIDEO",
        multiple=True,
        type=click.Path(path_type=Path),
        help="Film the run with AprilTags on the objects: a video, and its tags file beside it. Given"
        " twice, from two sides, so that the arm hides less. Needs the extra `vision`.",
    ),
)


class SimulationArguments(TypedDict):
    """How to simulate a world, as given on the command line."""

    seed: int
    noise: float
    inject: tuple[str, ...]
    start: tuple[str, ...]
    gui: bool
    cameras: tuple[Path, ...]


def simulation_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that say how to simulate a world; the command takes them as `simulation`."""
    return add_options(_SIMULATION, gather("simulation", SimulationArguments, command))


def show_film(simulation: SimulationArguments) -> None:
    """Print how to read the video of a run, if there is one."""
    videos = simulation["cameras"]
    if videos:
        from spatial_replay.runs.virtual_camera import tags_of_film

        listed = " ".join(str(video) for video in videos)
        tags = tags_of_film(videos)
        show(f"filmed {listed}: spatial-replay record video {listed} --tags {tags} -o seen.mcap")


def parse_injections(texts: Sequence[str]) -> list[Injection]:
    """Return the mishaps given on the command line.

    Raises:
        UsageError: an unknown one.
    """
    from spatial_replay.simulation.world import Injection

    return [Injection.parse(text) for text in texts]


def parse_starts(texts: Sequence[str]) -> list[Start]:
    """Return the starts of objects given on the command line.

    Raises:
        UsageError: one that is none, or two of one object.
    """
    from spatial_replay.simulation.world import Start

    starts = [Start.parse(text) for text in texts]
    names = [start.name for start in starts]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"--start: {name!r} is given twice; give one place")
    return starts


def recording_command(scenario: str) -> click.Command:
    """Return the command `record SCENARIO`."""
    help_text = f"""Record a simulated world: {SCENARIOS[scenario]}.

    The robot follows a script. Equal options give an equal log, byte for byte. Needs the extra `sim`.

    \b
    Examples:
      spatial-replay record {scenario} -o run.mcap
      spatial-replay record {scenario} -o run.mcap --seed 3 --duration 10s
      spatial-replay record {scenario} -o run.mcap --noise 0.002 --inject slip@4s
    """

    @click.command(scenario, help=help_text)
    @log_output_option("Log to write (MCAP).")
    @durability_option
    @specs_option(
        "Specification to evaluate while recording; repeat for several.  [default: the scenario's own]"
    )
    @constants_option
    @profile_option
    @click.option(
        "--duration",
        metavar="T",
        help="Simulated time, such as 10s.  [default: to the end of the script]",
    )
    @simulation_options
    def command(
        output: Path,
        durability: Durability,
        specs: tuple[LogFile, ...],
        constants: Mapping[str, float | str],
        profile: str | None,
        duration: str | None,
        simulation: SimulationArguments,
    ) -> int:
        # imported here so that --help stays fast
        from spatial_replay.runs.scripted import record_script
        from spatial_replay.simulation.worlds import default_specification

        files = load_spec_options(specs, profile, constants, lambda: default_specification(scenario))
        with progress("samples") as advance:
            recorded = record_script(
                scenario,
                output,
                files or None,
                seed=simulation["seed"],
                duration_ns=None if duration is None else duration_ns_from_text(duration),
                noise_m=simulation["noise"],
                injections=parse_injections(simulation["inject"]),
                starts=parse_starts(simulation["start"]),
                gui=simulation["gui"],
                cameras=simulation["cameras"],
                inputs=local_files(specs),
                advance=advance,
                durability=durability,
            )
        show(
            f"wrote {output}: {counted(recorded.samples, 'sample')} over {recorded.seconds:.3f} s of "
            f"{counted(len(recorded.objects), 'object')}: {', '.join(recorded.objects)}"
        )
        show(f"the robot: {recorded.outcome}")
        show_film(simulation)
        return ExitCode.SATISFIED

    return command


@click.group()
def record() -> None:
    """Record a run as a log (MCAP).

    \b
    Examples:
      spatial-replay record tracks blocks.jsonl.gz -o run.mcap
      spatial-replay record push -o run.mcap
      spatial-replay record video table.mp4 --tags tags.yaml -o run.mcap
    """


for _scenario in SCENARIOS:
    record.add_command(recording_command(_scenario))


record.add_command(video)


@record.command()
@click.argument("file", type=LogPath())
@log_output_option("Log to write (MCAP).")
@durability_option
@specs_option("Specification to evaluate while recording; repeat for several.")
@constants_option
@profile_option
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
    profile: str | None,
    reading: ReadArguments,
    unit: str,
) -> int:
    """Record the objects of any readable log: tracks, annotations, scenarios, bags with a mapping.

    Parts of the file that cannot be read are reported and left out; the exit code is then 3.

    \b
    Examples:
      spatial-replay record tracks blocks.jsonl.gz -o run.mcap
      spatial-replay record tracks people.csv -o run.mcap --spec social.spatial --unit m
      spatial-replay record tracks annotations.txt -o run.mcap --lost keep
    """
    # imported here so that --help stays fast
    from spatial_replay.recording import record_source
    from spatial_replay.sources.open_log import open_source

    inputs = input_files(file, *specs, reading=reading)
    source = open_source(file, **reading)
    files = load_spec_options(specs, profile, constants)
    with progress("samples") as advance:
        recorded = record_source(
            source, output, files, inputs=inputs, unit=unit, advance=advance, durability=durability
        )
    warn_of_input(recorded)
    seconds = (recorded.end_ns - recorded.start_ns) / 1e9
    show(
        f"wrote {output}: {counted(recorded.samples, 'sample')} over {seconds:.3f} s of "
        f"{counted(len(recorded.objects), 'object')}: {_listed(recorded.objects)}"
    )
    return ExitCode.DAMAGED if recorded.faults else ExitCode.SATISFIED


def _listed(names: tuple[str, ...]) -> str:
    shown = ", ".join(names[:8])
    return shown if len(names) <= 8 else f"{shown}, …"
