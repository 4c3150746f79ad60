"""Options that several commands share, and their values."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial, wraps
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from spatial_replay.cli.terminal import show_diagnostics, warn
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile, is_address, local_copy, local_files, log_file
from spatial_replay.monitor.verdict import ALLOWED_KINDS, FAILING_KINDS, checked_kinds
from spatial_replay.text import plural
from spatial_replay.trace.trace import time_point_from_text

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from spatial_replay.logs.read_options import Reading
    from spatial_replay.logs.source import Source
    from spatial_replay.monitor.verdict import Semantics
    from spatial_replay.recording.source_recording import Recorded
    from spatial_replay.replay.engine import Replayed
    from spatial_replay.replay.selection import ReplayOptions, Window
    from spatial_replay.spec.formula import Specification


_Command = TypeVar("_Command", bound=Callable[..., Any])
_Option = Callable[[Callable[..., Any]], Callable[..., Any]]


@dataclass(frozen=True, slots=True)
class ServingArguments:
    """Address of a server for viewers, and web pages that may connect."""

    host: str
    port: int
    origins: tuple[str, ...]

    def warn_of_access(self, what: str) -> None:
        """Warn of the access that other machines have, if they can reach the server."""
        # imported here so that --help stays fast
        from spatial_replay.serve.relay import is_loopback

        if not is_loopback(self.host):
            warn(f"who has this address, with its token, can {what}")


def serving_options(port: int, only_with: str = "") -> _Option:
    """Add the options of a server for viewers. The command receives them as `serving`.

    Args:
        port: default port.
        only_with: beginning of each help text: "With --serve: ".
    """

    def help_of(text: str) -> str:
        return f"{only_with}{text[0].lower() if only_with else text[0]}{text[1:]}"

    options = [
        click.option(
            "--port",
            metavar="P",
            type=click.IntRange(0, 65535),
            default=port,
            show_default=True,
            help=help_of("Port to listen on; 0 for any free port."),
        ),
        click.option(
            "--host",
            metavar="ADDRESS",
            default="127.0.0.1",
            show_default=True,
            help=help_of("Address to listen on; other machines need the printed token."),
        ),
        click.option(
            "--allow-origin",
            "origins",
            metavar="ORIGIN",
            multiple=True,
            help=help_of("Web page that may connect; repeat for several."),
        ),
    ]

    return lambda command: add_options(options, gather("serving", ServingArguments, command))


class JsonCommand(click.Command):
    """A command that prints JSON with `--json`. Like commands that write a file, it accepts `--json -`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        pairs = pairwise(["", *args])
        return super().parse_args(
            ctx, [word for previous, word in pairs if (previous, word) != ("--json", "-")]
        )


class LogPath(click.Path):
    """A path or an address of a log."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:
        return log_file(value) if is_address(value) else super().convert(value, param, ctx)


def _output_file(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    if path == Path("-"):
        raise click.BadParameter("'-' is not a file; only --json - writes to standard output")
    return path


def _log_file(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """Return the path of an output log, and refuse endings of other file types."""
    from spatial_replay.logs.output_file import refuse_ending

    if path is not None:
        refuse_ending(path)
    return _output_file(context, parameter, path)


_output_option = partial(click.option, "-o", "--output", type=click.Path(path_type=Path))


def output_option(text: str, *, required: bool = False) -> Callable[[_Command], _Command]:
    """Return the option `-o FILE`, with its help."""
    return _output_option(callback=_output_file, required=required, help=text)


def log_output_option(text: str, *, required: bool = True) -> Callable[[_Command], _Command]:
    """Return the option `-o FILE` of a command that writes a log, with its help."""
    return _output_option(callback=_log_file, required=required, help=text)


overwrite_option = click.option("--overwrite", is_flag=True, help="Replace a log that exists already.")
"""Option of commands whose recordings cannot be repeated."""

durability_option = click.option(
    "--durability",
    type=click.Choice(["process", "disk"]),
    default="process",
    show_default=True,
    help="Written chunks survive a crash of the process, or of the computer.",
)


def specs_option(text: str) -> Callable[[_Command], _Command]:
    """Return the repeatable option `--spec SPEC`, with its help."""
    return click.option("--spec", "specs", metavar="SPEC", multiple=True, type=LogPath(), help=text)


def _read_constants(
    context: click.Context, parameter: click.Parameter, texts: tuple[str, ...]
) -> Mapping[str, float | str]:
    if not texts:
        return {}
    # imported here so that --help stays fast
    from spatial_replay.spec.load import constants_from_texts

    with naming_option("--const"):
        return constants_from_texts(texts)


constants_option = click.option(
    "--const",
    "constants",
    metavar="NAME=VALUE",
    multiple=True,
    callback=_read_constants,
    help="Value of a constant, such as near=80; repeat for several.",
)


def keep_option(text: str, default: str = "all") -> Callable[[_Command], _Command]:
    """Return the repeatable option `--topics`; its help begins with `text` and names `default`."""
    return click.option(
        "--topics",
        "keep",
        metavar="all|mapped|PATTERN",
        multiple=True,
        help=f"{text}: all, of mapped topics, or of topics such as '/camera/*'.  [default: {default}]",
    )


semantics_option = click.option(
    "--semantics",
    type=click.Choice(["ltlf", "paper"]),
    default="ltlf",
    show_default=True,
    help="ltlf: finite traces; paper: Def. 16 of the paper.",
)


def _read_kinds(
    allowed_kinds: Sequence[str], context: click.Context, parameter: click.Parameter, text: str
) -> frozenset[str]:
    kinds = [kind.strip() for kind in text.split(",") if kind.strip()]
    return checked_kinds(parameter.opts[0], kinds, allowed_kinds)


fail_on_option = click.option(
    "--fail-on",
    metavar="KIND,…",
    callback=partial(_read_kinds, FAILING_KINDS),
    default="",
    help=f"Exit with 1 on these, too: {', '.join(FAILING_KINDS)}.",
)

allow_option = click.option(
    "--allow",
    metavar="KIND,…",
    callback=partial(_read_kinds, ALLOWED_KINDS),
    default="",
    help=f"Let these pass instead of exit code 4: {', '.join(ALLOWED_KINDS)}.",
)


def _allow_plugins(context: click.Context, parameter: click.Parameter, plugins: tuple[str, ...]) -> None:
    """Allow plug-ins until the command ends, also in the processes that it starts."""
    if not plugins:
        return
    # imported here so that --help stays fast
    from spatial_replay.spec.relations import PLUGINS_VARIABLE

    earlier_plugins = os.environ.get(PLUGINS_VARIABLE, "")
    plugin_paths = [str(Path(name).absolute()) if name.endswith(".py") else name for name in plugins]
    os.environ[PLUGINS_VARIABLE] = os.pathsep.join(filter(None, [earlier_plugins, *plugin_paths]))
    context.call_on_close(partial(os.environ.__setitem__, PLUGINS_VARIABLE, earlier_plugins))


plugin_option = click.option(
    "--plugin",
    metavar="MODULE",
    multiple=True,
    is_eager=True,
    expose_value=False,
    callback=_allow_plugins,
    help="Module or file with your own relations and signals; its code is run.",
)


def gather(name: str, values: Callable[..., Any], command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command that receives several options as one argument.

    Args:
        name: name of the argument.
        values: class of the argument; its fields have the names of the options.
    """

    @wraps(command)
    def gathering(**arguments: Any) -> Any:
        names = [field.name for field in fields(values)] if is_dataclass(values) else values.__annotations__
        values_by_name = {name: arguments.pop(name) for name in names}
        return command(**{name: values(**values_by_name)}, **arguments)

    return gathering


def add_options(options: Sequence[_Option], command: Callable[..., Any]) -> Callable[..., Any]:
    """Add options to a command, listed in this order by its help."""
    for option in reversed(options):
        command = option(command)
    return command


READING_KEYS = {
    "max_gap": "objects are unknown in longer pauses, such as 1s",
    "max_lateness": "how late messages of an external log may be, such as 5s or all",
    "rate": "frames a second of drone annotations",
    "lost": "keep boxes of drone annotations that are marked as lost",
    "y_down": "y points down in tracks or annotations",
    "concave": "take the hull of concave polygons",
    "on_time_jump": "end an external log where its clock jumps back",
}


def _read_pairs(
    context: click.Context, parameter: click.Parameter, texts: tuple[str, ...]
) -> dict[str, object]:
    options: dict[str, object] = {}
    for text in texts:
        key, _, value = text.partition("=")
        if key not in READING_KEYS or not value:
            raise UsageError(f"--read {text!r:.100}: give KEY=VALUE with one of {', '.join(READING_KEYS)}")
        try:
            options[key] = {"true": True, "false": False}.get(value) if key == "y_down" else float(value)
        except ValueError:
            options[key] = value
        if options[key] is None:
            raise UsageError(f"--read {text!r:.100}: give y_down=true or y_down=false")
    return options


_READING = (
    click.option(
        "--mapping",
        metavar="FILE",
        type=LogPath(),
        help="Mapping file (YAML) of an external log: topics and their objects.",
    ),
    click.option(
        "--read",
        metavar="KEY=VALUE",
        multiple=True,
        callback=_read_pairs,
        help="Reading option: max_gap=1s, max_lateness=5s, on_time_jump=split, rate=29.97, lost=keep,"
        " y_down=true, concave=hull; repeat for several.",
    ),
)


def reading_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of reading a log. The command receives the given options as `reading`."""

    @wraps(command)
    def gathering(*, read: dict[str, object], mapping: LogFile | None, **arguments: Any) -> Any:
        return command(reading=read if mapping is None else {"mapping": mapping} | read, **arguments)

    return add_options(_READING, gathering)


@dataclass(frozen=True, slots=True)
class ConditionArguments:
    """Command-line options on specifications and on reading logs."""

    specs: tuple[LogFile, ...]
    start: str | None
    end: str | None
    every: int
    choices: tuple[str, ...]
    constants: Mapping[str, float | str]
    strict_names: bool
    reading: Reading


@dataclass(frozen=True, slots=True)
class EvaluationArguments(ConditionArguments):
    """Specifications and options for one log."""

    log: LogFile

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The input files."""
        return input_files(self.log, *self.specs, reading=self.reading)


def input_files(*files: LogFile, reading: Reading) -> tuple[Path, ...]:
    """Return the files on this machine that a command reads, the mapping among them."""
    mapping = reading.get("mapping")
    return tuple(local_files(files if mapping is None else (*files, mapping)))


strict_names_option = click.option(
    "--strict-names",
    is_flag=True,
    help="Refuse names that are missing in the log, instead of a warning.",
)

choices_option = click.option(
    "--each",
    "choices",
    multiple=True,
    metavar="VAR=class:C|NAME|all",
    help="Objects for a template's parameter, such as ego=class:person.",
)

_CONDITIONS = (
    click.option(
        "--from",
        "start",
        metavar="T",
        help="Start at the first sample at or after T: 2s, or -5s before the end.",
    ),
    click.option(
        "--to", "end", metavar="T", help="End with the last sample before T: 60s, or -200ms before the end."
    ),
    click.option(
        "--every",
        metavar="N",
        type=click.IntRange(min=1),
        default=1,
        help="Use every Nth sample; bounds in samples count only these.",
    ),
    choices_option,
    constants_option,
    strict_names_option,
)


def evaluation_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add LOG and the options of an evaluation. The command receives them as `request`."""
    log = click.argument("log", type=LogPath())
    specs = specs_option("Specification; repeat for several.  [default: the log's own]")
    gathering = reading_options(gather("request", EvaluationArguments, command))
    return add_options((log, specs, *_CONDITIONS), gathering)


def condition_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a batch evaluation. The command receives them as `conditions`."""
    specs = specs_option("Specification file; repeat for several.")
    gathering = reading_options(gather("conditions", ConditionArguments, command))
    return add_options((specs, *_CONDITIONS), gathering)


@dataclass(frozen=True, slots=True)
class EvaluationInputs:
    """An open log and the specifications to evaluate over it."""

    source: Source
    files: Sequence[Specification]
    window: Window
    each: Mapping[str, str]
    strict_names: bool

    def options(self, semantics: Semantics = "ltlf", keep: tuple[str, ...] = ()) -> ReplayOptions:
        """Return the options of the evaluation.

        Args:
            keep: patterns of topics whose messages a copy of the log has.
        """
        from spatial_replay.replay.selection import ReplayOptions

        return ReplayOptions(self.window, self.each, semantics, self.strict_names, keep or None)


def open_inputs(
    request: EvaluationArguments, *, known: Sequence[Specification] = (), can_do_without: bool = False
) -> EvaluationInputs:
    """Open the log and load the specifications; their warnings go to standard error.

    Args:
        known: the specifications, if they are loaded already.
        can_do_without: whether a log without specifications is accepted.

    Raises:
        UsageError: an option is invalid.
        LogError, SpecificationError: an input cannot be read.
    """
    # imported here so that --help stays fast
    from spatial_replay.replay.engine import load_files, recorded_texts
    from spatial_replay.sources.open_log import open_source

    source = open_source(request.log, **request.reading)
    files = list(known)
    needs_no_specs = can_do_without and not (request.specs or request.constants or recorded_texts(source))
    if not files and not needs_no_specs:
        spec_paths = [local_copy(spec) for spec in request.specs]
        files = load_files(spec_paths, source, constants=request.constants)
        show_diagnostics(warning for file in files for warning in file.warnings)
    window, objects = _window(source, request), objects_by_parameter(request.choices)
    return EvaluationInputs(source, files, window, objects, request.strict_names)


def objects_by_parameter(choices: tuple[str, ...]) -> dict[str, str]:
    """Return the objects for each parameter of a template, as given by `--each`.

    Raises:
        UsageError: a choice is incomplete, or a parameter has two choices.
    """
    objects_by_name: dict[str, str] = {}
    for choice in choices:
        parameter, equals, objects = choice.partition("=")
        if not equals or not parameter:
            raise UsageError(f"--each {choice!r} is incomplete; write VAR=class:NAME, VAR=OBJECT or VAR=all")
        if parameter in objects_by_name:
            raise UsageError(
                f"--each gives {parameter!r} twice: {objects_by_name[parameter]!r} and {objects!r}"
            )
        objects_by_name[parameter] = objects
    return objects_by_name


def _window(source: Source, request: EvaluationArguments) -> Window:
    from spatial_replay.replay.selection import window_from_points

    with naming_option("--from"):
        start_point = None if request.start is None else time_point_from_text(request.start)
    with naming_option("--to"):
        end_point = None if request.end is None else time_point_from_text(request.end)
    try:
        return window_from_points(source, start_point, end_point, request.every)
    except UsageError:
        bound_options = (("--from", request.start), ("--to", request.end))
        window = " ".join(f"{name} {text}" for name, text in bound_options if text)
        raise UsageError(f"the window {window} is empty; --to is the time after its last sample") from None


def load_spec_options(
    specs: Sequence[LogFile],
    constants: Mapping[str, float | str],
    default: Callable[[], Specification] | None = None,
) -> list[Specification]:
    """Return the specifications of a command line, with its values of constants.

    Args:
        default: function that returns the specification of a command line with constants only.

    Raises:
        UsageError: no specification has a given constant.
        SpecificationError: a specification has errors.
    """
    # imported here so that --help stays fast
    from spatial_replay.spec.load import SpecificationText, load_specifications

    sources: list[Path | SpecificationText] = [*dict.fromkeys(map(local_copy, specs))]
    if constants and not sources and default is not None:
        specification = default()
        sources = [SpecificationText(specification.source, specification.filename)]
    return load_specifications(sources, constants=constants)


def refuse_values(options: Mapping[str, object], why: str) -> None:
    """Refuse options that do not apply.

    Args:
        options: values by the names of options.
        why: rest of the message, after the name of the option.

    Raises:
        UsageError: an option has a value.
    """
    for name, value in options.items():
        if value:
            raise UsageError(f"{name} {why}")


def refuse_options(context: click.Context, names: Collection[str], why: str) -> None:
    """Refuse options that do not apply, if they are on the command line.

    Args:
        names: the parameters' names in Python, such as "max_gap".
        why: the rest of the message, after the name of the option.

    Raises:
        UsageError: an option is given.
    """
    for parameter in context.command.params:
        value_source = context.get_parameter_source(parameter.name or "")
        if parameter.name in names and value_source is not ParameterSource.DEFAULT:
            raise UsageError(f"{parameter.opts[0]} {why}")


def check_outputs(outputs: Mapping[str, Path | str | None], inputs: Sequence[Path]) -> None:
    """Refuse outputs that cannot be written, before the work starts.

    Args:
        outputs: files by option name; None and "-" are no files.

    Raises:
        UsageError: an output is an input or a folder, its folder is missing, or two options name one file.
    """
    from spatial_replay.logs.output_file import refuse_inputs

    files = {name: Path(file) for name, file in outputs.items() if file is not None and file != "-"}
    for file in files.values():
        refuse_inputs(file, inputs)
        names = [name for name, path in files.items() if path.resolve() == file.resolve()]
        if len(names) > 1:
            raise UsageError(
                f"{' and '.join(names)} both name {outputs[names[-1]]}; give them different names"
            )


def require_choice(specification: Specification, of: str | None) -> None:
    """Require `--result` if a specification has several results.

    Raises:
        UsageError: there are several results, and none is chosen.
    """
    if of is None and len(specification.results) > 1:
        names = ", ".join(spec.name for spec in specification.results)
        raise UsageError(f"{specification.filename} has several results; choose one with --result: {names}")


def warn_of_input(result: Replayed | Recorded) -> None:
    """Warn of losses, remarks, unreadable observations and missing names in a log."""
    warn(*result.faults, *result.remarks)
    show_diagnostics(replace(name, severity="warning") for name in result.missing)
    if result.unreadable:
        count = plural(result.unreadable, "observation")
        is_single = result.unreadable == 1
        if result.remarks:
            warn(f"{count} {'is' if is_single else 'are'} unknown: see above, or not finite")
        else:
            warn(f"{count} {'holds' if is_single else 'hold'} a number that is not finite: unknown there")


@contextmanager
def naming_option(option: str) -> Iterator[None]:
    """Put the name of an option before the error about its value."""
    try:
        yield
    except UsageError as error:
        raise UsageError(f"{option}: {error}") from None
