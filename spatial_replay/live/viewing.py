"""A run as viewers see it while it goes on: scene, robustness, events and automata, over WebSocket."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import numpy as np

from spatial_replay.errors import importing
from spatial_replay.logs.messages import MemorySink, Messages
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.topics import OBJECTS, SPECIFICATION, protobuf_channel
from spatial_replay.mapping import LogMapping
from spatial_replay.recording.log import Missed, Recording, RunEnd, RunEvent, refuse_templates, warm_up
from spatial_replay.recording.recorder import SampleWriter
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

if TYPE_CHECKING:
    from spatial_replay.serve.server import RunServer

_GATHER_S: Final = 1 / 30
"""How long samples are gathered before viewers are sent them."""

_WAITING: Final = 4_096


class _ViewerLog:
    """The log of a run, of which nothing is kept: viewers are sent each message; see `RecorderLog`."""

    gather_s = _GATHER_S
    is_busy = False
    backlog = 0

    def __init__(self, files: Sequence[Specification], about: Mapping[str, str], server: RunServer) -> None:
        self._server = server
        self._sink = MemorySink()
        self._recording = Recording(self._sink, files, about)
        warm_up(files, self._recording.automata)
        self._specification: Messages | None = None
        self.is_asked = False
        """Whether a viewer has subscribed since the last sample, and shows nothing yet."""

    def add(self, samples: Sequence[Sample], trace: Trace, messages: Messages) -> None:
        """Send the next samples and messages, and what follows from them."""
        is_asked = self.is_asked and len(trace) > 0
        if is_asked:
            self.is_asked = False
            self._recording.redraw()
        self._recording.add(trace, messages)
        self._remember_specification()
        self._publish()
        if len(trace):
            newest_ns = int(trace.times_ns[-1])
            self._server.send_time(newest_ns)
            if self._specification is not None and is_asked:
                self._server.publish(_at(self._specification, newest_ns))

    def miss(self, time_ns: int, kind: Missed) -> None:
        """Viewers miss it unseen."""

    def report(self, event: RunEvent) -> None:
        """Send what happens to the run beside its samples."""
        self._recording.report(event)
        self._publish()

    def flush(self) -> None:
        """Nothing waits."""

    def end(self, end: RunEnd) -> None:
        """Send the events at the end."""
        self._recording.end(interrupted=end.interrupted)
        self._publish()

    def break_off(self, end: RunEnd) -> None:
        """Nothing follows."""

    def close(self) -> None:
        """Nothing is open."""

    def _publish(self) -> None:
        for made in self._sink.messages:
            self._server.publish(made)
        self._sink.messages.clear()

    def _remember_specification(self) -> None:
        for made in self._sink.messages if self._specification is None else ():
            for number, channel in made.channels.items():
                if channel.topic == SPECIFICATION:
                    place = np.flatnonzero(made.channel == number)[:1]
                    if len(place):
                        self._specification = Messages(
                            {0: channel},
                            np.zeros(1, np.int64),
                            np.zeros(1, np.int64),
                            made.log_time_ns[place],
                            made.publish_time_ns[place],
                            [made.payloads[int(place[0])]],
                        )


def _at(messages: Messages, time_ns: int) -> Messages:
    times_ns = np.array([time_ns], np.int64)
    return Messages(
        messages.channels, messages.channel, messages.sequence, times_ns, times_ns, messages.payloads
    )


class Viewing(SampleWriter):
    """Shows a run to viewers: a writer that a session is given beside recorders."""

    def __init__(self, files: Sequence[Specification], about: Mapping[str, str], server: RunServer) -> None:
        """Compile everything."""
        refuse_templates(files)
        self.address = server.address
        self._view = _ViewerLog(files, about, server)
        super().__init__(self._view, "the view", _WAITING, block=False)

    def ask(self) -> None:
        """Send everything that is shown with the next sample."""
        self._view.is_asked = True


@contextmanager
def open_viewing(
    files: Sequence[Specification],
    mapping: LogMapping | None,
    *,
    host: str,
    port: int,
    origins: Sequence[str] = (),
    fire: Callable[[str], None] | None = None,
) -> Iterator[Viewing]:
    """Serve a run to viewers while it goes on.

    Args:
        port: 0 for any that is free.
        origins: of web pages that may connect, besides those of Foxglove and of this machine.
        fire: what the service `trigger` calls, with the reason that it is given.

    Raises:
        UsageError: nothing can listen there, a text that is no origin, or the library for it is not
            installed.
    """
    with importing("serving takes foxglove-sdk", extra="live"):
        from spatial_replay.serve.server import RunServer
    channels = [*Recording(MemorySink(), files).channels, protobuf_channel(OBJECTS, ObjectStates)]
    viewing: Viewing | None = None

    def ask() -> None:
        if viewing is not None:
            viewing.ask()

    server = RunServer(channels, host, port, ask, fire, origins)
    try:
        viewing = Viewing(files, _axes(mapping), server)
        try:
            yield viewing
        finally:
            viewing.close()
    finally:
        server.stop()


def layout_of_run(files: Sequence[Specification], mapping: LogMapping | None) -> str:
    """Return the layout for viewers of a run, as JSON: its curves and states are drawn as they come.

    Raises:
        UsageError: a template, since its objects are not known yet.
    """
    recording = Recording(MemorySink(), files, _axes(mapping))
    return recording.layout_ahead().data.decode()


def _axes(mapping: LogMapping | None) -> Mapping[str, str]:
    return {} if mapping is None else mapping.metadata()
