"""A live server from its start to its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Thread
from typing import TYPE_CHECKING

from spatial_replay.annotate.robustness import CURVES_CHANNEL
from spatial_replay.errors import SpatialReplayError, importing
from spatial_replay.replay.loaded_log import EditedFiles, Evaluated, Playback
from spatial_replay.serve.player import SPECIFICATION, Note, Player, Questions, Session
from spatial_replay.spec.formula import Specification

if TYPE_CHECKING:
    from spatial_replay.serve.server import LiveServer

LOOPBACK = "127.0.0.1"
PORT = 8765
"""The port that viewers connect to by default."""

_STOP_S = 0.25
"""How long a running evaluation is waited for at the end."""


@dataclass(frozen=True)
class Serving:
    """A running server.

    Attributes:
        address: the address that viewers connect to: ws://127.0.0.1:8765.
    """

    address: str
    _loop: Future[None]
    _session: Session
    _server: LiveServer

    def wait(self) -> None:
        """Wait until the server ends, which happens only through an error, and raise that."""
        self._loop.result()

    def check(self) -> None:
        """Raise the error that ended the server, if it ended."""
        if self._loop.done():
            self._loop.result()

    @property
    def edited(self) -> EditedFiles:
        """The specifications with the constants as viewers set them."""
        return self._session.edited

    def show_saved(self, files: Sequence[Specification]) -> Evaluated:
        """Evaluate specifications that were saved, show viewers what they give, and return it.

        Constants that viewers changed keep their values, unless the text changed them, too. After an error
        what was shown before stays, and viewers are shown the error.

        Raises:
            SpatialReplayError: it cannot be evaluated over this log.
        """
        try:
            loaded = self.edited.loaded.with_files(files)
            self._session.replace_log(loaded)
            evaluated = self._session.wait_for_evaluation()
            if evaluated.loaded is not loaded and self._session.failure is not None:
                raise self._session.failure
        except SpatialReplayError as error:
            self.show_error(error)
            raise
        self._server.remove_note(SPECIFICATION)
        return evaluated

    def show_error(self, error: SpatialReplayError) -> None:
        """Show viewers why a specification that was saved cannot be evaluated."""
        self._server.send_note(Note(SPECIFICATION, str(error)))


@contextmanager
def open_server(
    evaluated: Evaluated,
    *,
    host: str = LOOPBACK,
    port: int = PORT,
    play: bool = False,
    origins: Sequence[str] = (),
) -> Iterator[Serving]:
    """Serve a log to viewers, which play it and change the constants of its specifications.

    Args:
        evaluated: the evaluation to show first, with the constants as they are written.
        host: the address to listen at; from beyond this machine, the address with its token is needed.
        port: 0 for any that is free.
        play: play at once; otherwise wait at the start for a viewer to do so.
        origins: of web pages that may connect, besides those of Foxglove and of this machine.

    Raises:
        UsageError: nothing can listen there, a text that is no origin, or the library for it is not
            installed.
        LogError: the log cannot be read.
    """
    with importing("serving takes foxglove-sdk", extra="live"):
        from spatial_replay.serve.server import LiveServer
    playback = Playback(evaluated)
    playback.seek(playback.start_ns)
    session = Session(evaluated.loaded, playback.start_ns, playback.end_ns)
    questions = Questions(session.wait_for_evaluation)
    server = LiveServer(session, questions, (*playback.channels, CURVES_CHANNEL), host, port, origins)
    loop = _in_background(Player(playback, session, server).run, "player")
    answering = _in_background(questions.run, "questions")
    try:
        if play:
            session.control(is_playing=True, speed=1.0)
        yield Serving(server.address, loop, session, server)
    finally:
        session.stop()
        questions.stop()
        wait([loop, answering], _STOP_S)
        server.stop()


def _in_background(work: Callable[[], None], name: str) -> Future[None]:
    """Do work on a daemon thread, which the end of the process does not wait for."""
    ended: Future[None] = Future()

    def run() -> None:
        try:
            work()
        except BaseException as error:
            ended.set_exception(error)
        else:
            ended.set_result(None)

    Thread(target=run, name=name, daemon=True).start()
    return ended
