"""`spatial-replay record`: turn a run into a log.

`spatial-replay record push` and its like: simulated worlds, and the options that they have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypedDict

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    Reading,
    duration_ns_from_text,
    output_option,
    profile_option,
    reading_options,
    report_reading,
)
from spatial_replay.cli.progress import progress
from spatial_replay.text import counted

if TYPE_CHECKING:
    from spatial_replay.simulation.injection import Injection
    from spatial_replay.spec.formula import Specification

SCENARIOS: Mapping[str, str] = MappingProxyType(
    {
        "push": "three blocks on a table, and a robot that pushes them",
        "pick-place": "nine things on a table, and a robot that picks and places them",
        "table-setting": "cutlery, a cup and a plate, and a robot that sets the table",
    }
)
"""The simulated worlds, and what there is in each."""

_OPTIONS = (
    click.option(
        "--seed", type=click.IntRange(0), default=0, help="Where things lie, and noise.  [default: 0]"
    ),
    click.option(
        "--noise",
        metavar="METRES",
        type=click.FloatRange(0),
        default=0.0,
        help="Detection is off by up to this much, and the recorded uncertainty says so.  [default: 0]",
    ),
    click.option(
        "--inject",
        metavar="MISHAP",
        multiple=True,
        help="What goes wrong: drop@7s, slip@7s, or slip for the whole run; repeat it for several.",
    ),
    click.option(
        "--gui",
        is_flag=True,
        help="Show the world in a window, no faster than real time. Needs a display.",
    ),
)


class Simulating(TypedDict):
    """How a world is simulated: what `record_script` takes of it, as written."""

    seed: int
    noise: float
    inject: tuple[str, ...]
    gui: bool


def simulation_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say how a world is simulated; the command takes them together, as `simulating`."""

    @wraps(command)
    def with_simulating(**given: Any) -> Any:
        simulating: dict[str, Any] = {name: given.pop(name) for name in Simulating.__annotations__}
        return command(simulating=simulating, **given)

    decorated: Callable[..., Any] = with_simulating
    for option in reversed(_OPTIONS):
        decorated = option(decorated)
    return decorated


def injections_from(texts: Sequence[str]) -> list[Injection]:
    """The mishaps that were asked for.

    Raises:
        UsageError: one that is written otherwise.
    """
    from spatial_replay.simulation.injection import Injection

    return [Injection.parse(text) for text in texts]


def recording_command(scenario: str) -> click.Command:
    """`record SCENARIO`."""
    help_text = f"""Record a simulated world: {SCENARIOS[scenario]}.

    The robot follows a script. Equal options give an equal log, byte for byte. Needs the extra `sim`.

    \b
    Examples:
      spatial-replay record {scenario} -o run.mcap
      spatial-replay record {scenario} -o run.mcap --spec edited.spatial --seed 3 --duration 10s
      spatial-replay record {scenario} -o run.mcap --noise 0.002 --inject slip@4s
    """

    @click.command(scenario, help=help_text)
    @output_option("Write the log here.", required=True)
    @click.option(
        "--spec",
        "specs",
        metavar="SPEC",
        multiple=True,
        type=click.Path(path_type=Path),
        help="Evaluate this specification meanwhile instead of the scenario's own; repeat it for several.",
    )
    @profile_option
    @click.option(
        "--duration",
        metavar="T",
        help="How long, such as 10s of simulated time.  [default: the script's end]",
    )
    @simulation_options
    def command(
        output: Path,
        specs: tuple[Path, ...],
        profile: str | None,
        duration: str | None,
        simulating: Simulating,
    ) -> int:
        # the simulator and the numerical libraries load when there is work for them
        from spatial_replay.runs.scripted import record_script

        files = specifications_from(specs, profile)
        with progress("samples") as advance:
            recorded = record_script(
                scenario,
                output,
                files,
                seed=simulating["seed"],
                duration_ns=None if duration is None else duration_ns_from_text(duration),
                noise_m=simulating["noise"],
                injections=injections_from(simulating["inject"]),
                gui=simulating["gui"],
                inputs=specs,
                advance=advance,
            )
        click.echo(
            f"wrote {output}: {counted(recorded.samples, 'sample')} over {recorded.seconds:.3f} s of "
            f"{counted(len(recorded.objects), 'object')}: {', '.join(recorded.objects)}"
        )
        click.echo(f"the robot: {recorded.outcome}")
        return ExitCode.SATISFIED

    return command


def specifications_from(paths: Sequence[Path], profile: str | None) -> list[Specification] | None:
    """The specifications of some files; None, for the scenario's own, of no file.

    Raises:
        SpecificationError: one has faults.
        UsageError: one is not there.
    """
    from spatial_replay.spec import load_specification

    return [load_specification(path, profile=profile) for path in paths] or None


@click.group()
def record() -> None:
    """Record a run as an MCAP log.

    \b
    Examples:
      spatial-replay record tracks blocks.jsonl.gz -o run.mcap
      spatial-replay record push -o run.mcap
    """


for _scenario in SCENARIOS:
    record.add_command(recording_command(_scenario))


@record.command()
@click.argument("file", type=click.Path(path_type=Path))
@output_option("Write the log here.", required=True)
@click.option(
    "--spec",
    "specs",
    metavar="SPEC",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Evaluate this specification meanwhile; repeat it for several.",
)
@profile_option
@reading_options
def tracks(file: Path, output: Path, specs: tuple[Path, ...], profile: str | None, reading: Reading) -> int:
    """Record the objects of any log that can be read: tracks, annotations, scenarios, bags with a mapping.

    What cannot be read of the file is reported and left out, and the exit code is then 3.

    \b
    Examples:
      spatial-replay record tracks blocks.jsonl.gz -o run.mcap
      spatial-replay record tracks people.csv -o run.mcap --spec social.spatial
      spatial-replay record tracks annotations.txt -o run.mcap --lost keep
    """
    # the numerical libraries load when there is work for them
    from spatial_replay.recording import record_source
    from spatial_replay.sources.open_log import open_source
    from spatial_replay.spec import load_specification

    mapping = reading["mapping"]
    inputs = (file, *specs, *([] if mapping is None else [mapping]))
    source = open_source(file, **reading)
    files = [load_specification(spec, profile=profile) for spec in specs]
    with progress("samples") as advance:
        recorded = record_source(source, output, files, inputs=inputs, advance=advance)
    report_reading(recorded)
    for name in recorded.missing:
        click.echo(replace(name, severity="warning"), err=True)
    seconds = (recorded.end_ns - recorded.start_ns) / 1e9
    click.echo(
        f"wrote {output}: {counted(recorded.samples, 'sample')} over {seconds:.3f} s of "
        f"{counted(len(recorded.objects), 'object')}: {_listed(recorded.objects)}"
    )
    return ExitCode.DAMAGED if recorded.faults else ExitCode.SATISFIED


def _listed(names: tuple[str, ...]) -> str:
    shown = ", ".join(names[:8])
    return shown if len(names) <= 8 else f"{shown}, …"
