"""`spatial-replay monitor`: listen to a running robot, and print its verdicts as they change."""

from __future__ import annotations

import asyncio
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from spatial_replay.cli.application import ExitCode, exit_code_from_verdicts
from spatial_replay.cli.options import (
    ServingArguments,
    constants_option,
    load_spec_options,
    naming_option,
    output_option,
    overwrite_option,
    refuse_options,
    refuse_values,
    serving_options,
    specs_option,
)
from spatial_replay.cli.output import change_line, ending_lines
from spatial_replay.cli.terminal import Line, StatusLine, show, show_diagnostics, show_file, warn
from spatial_replay.errors import UsageError
from spatial_replay.text import plural, time_text
from spatial_replay.trace.trace import duration_ns_from_text

if TYPE_CHECKING:
    from spatial_replay.live import LiveSession, LiveUpdate
    from spatial_replay.live.session import Viewing
    from spatial_replay.mapping.mapping_file import LogMapping
    from spatial_replay.recording.clips import Trigger
    from spatial_replay.recording.recorder import Recorder, SampleWriter
    from spatial_replay.spec.formula import Specification

_STATUS_S: Final = 0.5
_GONE_S: Final = 30.0
"""Longest absence of the server in a run with --until, seconds."""
_UNITS: Final = {"kb": 2**10, "mb": 2**20, "gb": 2**30}


def _seconds(context: click.Context, parameter: click.Parameter, text: str | None) -> float | None:
    if text is None:
        return None
    with naming_option(parameter.opts[0]):
        return duration_ns_from_text(text) / 1e9


def _bytes(context: click.Context, parameter: click.Parameter, text: str) -> int:
    size_text, unit_bytes = text.strip(), 1
    for unit, multiple in _UNITS.items():
        if size_text.lower().endswith(unit):
            size_text, unit_bytes = size_text[: -len(unit)], multiple
    with suppress(ValueError, OverflowError):
        return round(float(size_text) * unit_bytes)
    raise UsageError(f"{parameter.opts[0]}: {text!r} is not a size; write it as 256MB or 1.5GB")


@click.command()
@click.argument("address", metavar="ADDRESS")
@specs_option("Specification file; repeat for several.")
@click.option(
    "--mapping",
    "mapping_file",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Mapping file (YAML).  [default: samples on /spatial/objects]",
)
@constants_option
@output_option("Log of the whole run to write (MCAP).")
@overwrite_option
@click.option(
    "--topics",
    metavar="PATTERN",
    multiple=True,
    help="Messages to write, such as '/camera/*'; repeat.  [default: mapped]",
)
@click.option("--for", "length_s", metavar="T", callback=_seconds, help="Duration of the run, such as 60s.")
@click.option(
    "--until",
    metavar="WHEN",
    type=click.Choice(["violated", "satisfied", "settled"]),
    help="End when any result is violated, all are satisfied, or all are settled; also when none can be.",
)
@click.option(
    "--topic-timeout",
    "topic_timeout_s",
    metavar="T",
    callback=_seconds,
    help="Objects of a topic become unknown after T without messages.",
)
@click.option(
    "--start-within",
    "start_within_s",
    metavar="T",
    callback=_seconds,
    help="Longest wait for the first messages of needed topics.  [default: their max_age]",
)
@click.option(
    "--max-delay",
    "max_delay_s",
    metavar="T",
    callback=_seconds,
    default="200ms",
    show_default=True,
    help="Longest wait of a sample for late messages.",
)
@click.option(
    "--trigger",
    "triggers",
    metavar="WHEN",
    multiple=True,
    help="Write a clip when: violated, 'NAME satisfied', 'NAME < 0.2', 'NAME < 0.2 possible', event, manual;"
    " repeat for several.",
)
@click.option(
    "--before",
    "before_s",
    metavar="T",
    callback=_seconds,
    default="10s",
    show_default=True,
    help="With --clips: time kept before a trigger.",
)
@click.option(
    "--after",
    "after_s",
    metavar="T",
    callback=_seconds,
    default="5s",
    show_default=True,
    help="With --clips: time kept after a trigger.",
)
@click.option("--clips", metavar="DIR", type=click.Path(path_type=Path), help="Folder for clips.")
@click.option(
    "--ring",
    metavar="SIZE",
    callback=_bytes,
    default="256MB",
    show_default=True,
    help="With --clips: memory for messages.",
)
@click.option("--serve", "serves", is_flag=True, help="Show the monitored run to viewers over WebSocket.")
@serving_options(8766, "With --serve: ")
@click.option("--layout", is_flag=True, help="Print the layout to import in the viewer, and exit.")
def monitor(
    address: str,
    specs: tuple[Path, ...],
    mapping_file: Path | None,
    constants: Mapping[str, float | str],
    output: Path | None,
    overwrite: bool,
    topics: tuple[str, ...],
    length_s: float | None,
    until: str | None,
    topic_timeout_s: float | None,
    start_within_s: float | None,
    max_delay_s: float,
    triggers: tuple[str, ...],
    before_s: float,
    after_s: float,
    clips: Path | None,
    ring: int,
    serves: bool,
    serving: ServingArguments,
    layout: bool,
) -> ExitCode:
    """Monitor a running robot through foxglove_bridge, or another Foxglove WebSocket server.

    Prints each change of a verdict with its reason. While the connection is lost, everything is unknown.
    Ctrl-C ends the run. Exits with 0 if all results are satisfied, 1 if any is violated, 4 if any is unknown
    or doubtful, 3 if the server does not answer or its time jumps back.

    With --clips, nothing is written until a trigger fires. Each trigger writes a log of the time before and
    after it. SIGUSR1 and the service `trigger` of --serve also fire the trigger.

    \b
    Examples:
      spatial-replay monitor ws://robot:8765 --mapping drive.yaml --spec safety.spatial
      spatial-replay monitor ws://robot:8765 --spec safety.spatial --for 60s -o live.mcap
      spatial-replay monitor ws://robot:8765 --spec safety.spatial --trigger violated --clips clips/
    """
    signal_trigger = _SignalTrigger()
    if clips is not None:
        click.get_current_context().with_resource(signal_trigger.listening())
    # imported here so that --help stays fast
    from spatial_replay.live import LiveSession, open_recorders
    from spatial_replay.live.session import layout_of_run
    from spatial_replay.logs.output_file import refuse_inputs
    from spatial_replay.mapping.mapping_file import load_mapping

    if not specs:
        raise UsageError("there is nothing to monitor; give --spec FILE")
    if output is None and clips is None:
        refuse_values({"--topics": topics}, "says which messages are written; add -o FILE or --clips DIR")
    if clips is None:
        refuse_values({"--trigger": triggers}, "writes clips; add --clips DIR")
        context = click.get_current_context()
        refuse_options(context, ("before_s", "after_s", "ring"), "is about clips; add --clips DIR")
    for option, span_s in (
        ("--for", length_s),
        ("--topic-timeout", topic_timeout_s),
        ("--start-within", start_within_s),
        ("--max-delay", max_delay_s),
    ):
        if span_s is not None and span_s <= 0:
            raise UsageError(f"{option} is 0; give it a length, as in {option} 2s")
    files = load_spec_options(specs, constants)
    show_diagnostics(warning for file in files for warning in file.warnings)
    if until == "satisfied":
        _refuse_endless(files)
    mapping = None if mapping_file is None else load_mapping(mapping_file)
    if layout:
        show_file(layout_of_run(files, mapping))
        return ExitCode.SATISFIED
    trigger = None if clips is None else _trigger(triggers, before_s, after_s, ring)
    if output is not None:
        refuse_inputs(output, [*specs, *([mapping_file] if mapping_file is not None else [])])
    with ExitStack() as resources:
        recorders = resources.enter_context(
            open_recorders(files, mapping, output, trigger, clips, overwrite=overwrite)
        )
        writers: list[SampleWriter] = [*recorders]
        fire = next((recorder.trigger for recorder in recorders if trigger and recorder.is_triggered), None)
        if fire is not None:
            signal_trigger.attach(fire)
        if serves:
            writers.append(resources.enter_context(_viewing(files, mapping, serving, fire)))
        session = LiveSession(
            address,
            files,
            mapping,
            recorders=writers,
            topics=topics,
            max_delay_s=max_delay_s,
            topic_timeout_s=topic_timeout_s,
            start_within_s=start_within_s,
        )
        run = _Run(session, recorders, length_s, until)
        asyncio.run(run.follow())
    run.show_remarks()
    for clip in (clip for recorder in recorders for clip in recorder.clips):
        loss_text = f"; {plural(clip.dropped, 'sample')} of its time dropped" if clip.dropped else ""
        show(f"clip {clip.path}: {clip.reason} at {time_text(clip.time_ns, run.first_ns)}{loss_text}")
    _show_losses(writers, session.status.dropped)
    if output is not None:
        show(f"wrote {output}")
    return run.exit_code


def _refuse_endless(files: Sequence[Specification]) -> None:
    """Refuse --until satisfied for specs that a run can still violate at any later time."""
    from spatial_replay.spec.walks import can_settle

    specs = [spec for file in files for spec in file.results]
    endless_specs = [spec.name for spec in specs if not can_settle(spec.formula, satisfied=True)]
    if endless_specs:
        raise UsageError(
            f"--until satisfied: {', '.join(endless_specs)} can be violated as long as the run goes on; give"
            " --for T, --until violated, or a file without it"
        )


def _show_losses(writers: Sequence[SampleWriter], dropped: int) -> None:
    """Show the losses of logs, clips and viewers beyond `dropped`, the number of unevaluated samples."""
    for writer in writers:
        losses = [plural(writer.dropped - dropped, "sample")] if writer.dropped > dropped else []
        losses += [plural(writer.messages_dropped, "message")] if writer.messages_dropped else []
        if losses:
            show(f"{writer.name} fell behind and lacks {' and '.join(losses)}")


class _SignalTrigger:
    """Fires the trigger at SIGUSR1. An earlier signal waits until the recorder exists."""

    def __init__(self) -> None:
        self._fire: Callable[[str], None] | None = None
        self._has_signal = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Handle the signal within this context."""
        try:
            previous_handler = signal.signal(signal.SIGUSR1, self._take)
        except ValueError:
            # only the main thread may handle signals
            yield
            return
        try:
            yield
        finally:
            signal.signal(signal.SIGUSR1, previous_handler)

    def attach(self, fire: Callable[[str], None]) -> None:
        """Set the function that fires the trigger."""
        self._fire = fire
        if self._has_signal:
            fire("SIGUSR1")

    def _take(self, number: int, frame: object) -> None:
        if self._fire is None:
            self._has_signal = True
        else:
            self._fire("SIGUSR1")


def _trigger(conditions: tuple[str, ...], before_s: float, after_s: float, ring_bytes: int) -> Trigger:
    from spatial_replay.recording.clips import Trigger

    if ring_bytes < 2**20:
        raise UsageError(f"--ring is {ring_bytes} bytes; a ring takes 1MB or more")
    with naming_option("--trigger"):
        return Trigger(conditions or "violated", before_s, after_s, ring_bytes)


@contextmanager
def _viewing(
    files: Sequence[Specification],
    mapping: LogMapping | None,
    serving: ServingArguments,
    fire: Callable[[str], None] | None,
) -> Iterator[Viewing]:
    from spatial_replay.live.session import open_viewing

    host, port, origins = serving.host, serving.port, serving.origins
    with open_viewing(files, mapping, host=host, port=port, origins=origins, fire=fire) as viewing:
        serving.warn_of_access("see this robot" + (" and fire the trigger" if fire is not None else ""))
        show(f"serving at {viewing.address}")
        show(f"  in Foxglove or Lichtblick: Open connection, Foxglove WebSocket, {viewing.address}")
        show("  layout to import there: run the same command with --layout > live.json")
        yield viewing


class _Run:
    """A session on a terminal, from its start to its end."""

    def __init__(
        self, session: LiveSession, recorders: Sequence[Recorder], length_s: float | None, until: str | None
    ) -> None:
        self._session, self._recorders = session, recorders
        self._length_s, self._until = length_s, until
        from spatial_replay.spec.walks import horizon_ns

        specs = [spec for file in session.files for spec in file.results]
        # a spec that is pending after its horizon stays unknown
        self._horizons_ns = [horizon_ns(spec.formula) for spec in specs]
        self._status = StatusLine()
        self.first_ns = 0
        self._verdicts: list[str] = []

    async def follow(self) -> None:
        """Print changes and notes until the run ends, and then the verdicts."""
        loop = asyncio.get_running_loop()
        with self._signals(loop):
            status_task = asyncio.create_task(self._tick())
            end_task = asyncio.create_task(self._end_in_time())
            try:
                is_first = True
                async for update in self._session.updates():
                    if is_first:
                        self.first_ns, is_first = update.time_ns, False
                    self._show(update)
                    if self._is_over(update):
                        self._session.stop()
                        break
            finally:
                status_task.cancel()
                end_task.cancel()
                self._status.clear()
        self._session.close()
        self._show_end()

    @property
    def exit_code(self) -> ExitCode:
        """The code for the verdicts at the end."""
        return exit_code_from_verdicts(self._verdicts, damaged=self._session.failure is not None)

    def show_remarks(self) -> None:
        """Print the remarks of recorders."""
        for recorder in self._recorders:
            for remark in recorder.take_remarks():
                self._print(f"  {remark}")

    @contextmanager
    def _signals(self, loop: asyncio.AbstractEventLoop) -> Iterator[None]:
        """End the run at the first Ctrl-C. The second Ctrl-C interrupts the program."""
        handled_signals: list[signal.Signals] = []

        def stop(signal_number: signal.Signals) -> None:
            self._session.stop()
            loop.remove_signal_handler(signal_number)

        # only the main thread may handle signals
        with suppress(NotImplementedError, RuntimeError, ValueError):
            for signal_number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(signal_number, stop, signal_number)
                handled_signals.append(signal_number)
        try:
            yield
        finally:
            for signal_number in handled_signals:
                loop.remove_signal_handler(signal_number)

    async def _end_in_time(self) -> None:
        if self._length_s is not None:
            await self._session.connected.wait()
            await asyncio.sleep(self._length_s)
            self._session.stop()

    async def _tick(self) -> None:
        """Update the status line, and print notes that come without a sample."""
        last_status, last_s = self._session.status, time.monotonic()
        rate_hz, last_connected_s = 0.0, math.inf
        while True:
            await asyncio.sleep(_STATUS_S)
            status, now_s = self._session.status, time.monotonic()
            for note in self._session.take_notes():
                self._print(f"  {note}")
            self.show_remarks()
            # smoothed, so that the shown rate is readable
            rate_hz += 0.5 * ((status.samples - last_status.samples) / (now_s - last_s) - rate_hz)
            last_status, last_s = status, now_s
            self._status.show(self._status_text(rate_hz))
            last_connected_s = now_s if status.is_connected else last_connected_s
            if self._until is not None and now_s - last_connected_s > _GONE_S:
                self._print(
                    f"  the server has been away for {_GONE_S:g} s: the run ends before `{self._until}`"
                )
                self._session.stop()

    def _status_text(self, rate_hz: float) -> str:
        status = self._session.status
        if not status.is_connected:
            return "not connected"
        if status.waits_for:
            return f"waiting for {', '.join(status.waits_for)}"
        if status.time_ns is None:
            return f"connected, no sample yet ({plural(status.messages, 'message')})"
        status_texts = [time_text(status.time_ns, self.first_ns), f"{rate_hz:.0f} samples/s"]
        status_texts.append(f"delay {status.delay_s * 1e3:.1f} ms")
        status_texts.append(f"dropped {status.dropped}")
        if status.messages_dropped:
            status_texts.append(f"messages dropped {status.messages_dropped}")
        if status.late:
            status_texts.append(f"late {status.late}")
        if status.overdue:
            status_texts.append(f"without transforms {status.overdue}")
        return "   ".join(status_texts)

    def _show(self, update: LiveUpdate) -> None:
        for note in update.notes:
            self._print(f"  {note}")
        for change in update.changes:
            self._print(change_line(change, self.first_ns))

    def _is_over(self, update: LiveUpdate) -> bool:
        verdicts = {str(spec.verdict) for spec in update.specs}
        elapsed_ns = update.time_ns - self.first_ns
        specs = zip(update.specs, self._horizons_ns, strict=True)
        within_horizon = [
            elapsed_ns <= horizon_ns for spec, horizon_ns in specs if str(spec.verdict) == "pending"
        ]
        is_open = any(within_horizon)
        if not all(within_horizon):
            verdicts.add("unknown")
        match self._until:
            case "violated":
                return "violated" in verdicts or not is_open
            case "satisfied":
                return not (is_open and verdicts.isdisjoint({"violated", "unknown"}))
            case "settled":
                return not is_open
        return False

    def _show_end(self) -> None:
        for note in self._session.take_notes(last=True):
            show(f"  {note}")
        status = self._session.status
        warn(*self._session.remarks)
        if self._session.failure is not None:
            warn(str(self._session.failure))
        endings = self._session.endings()
        self._verdicts = [str(ending.verdict) for ending in endings]
        self._verdicts += ["unknown" for ending in endings if ending.doubts]
        span_text = "no time" if status.time_ns is None else time_text(status.time_ns, self.first_ns)
        loss_text = ""
        if status.dropped or status.messages_dropped:
            loss_text = f"; dropped {plural(status.dropped, 'sample')} and"
            loss_text += f" {plural(status.messages_dropped, 'message')}: verdicts are over the others"
        show(f"{plural(status.samples, 'sample')} over {span_text}{loss_text}")
        show(*ending_lines(endings))

    def _print(self, line: Line) -> None:
        self._status.clear()
        show(line)
