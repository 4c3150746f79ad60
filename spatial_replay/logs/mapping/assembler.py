"""Messages to samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.foreign.messages import Decoder, Message
from spatial_replay.logs.mapping.plan import Plan
from spatial_replay.trace.trace import Trace

OnTimeJump: TypeAlias = Literal["error", "split"]
"""What becomes of a log whose time jumps back by more than a second: it is refused, or it ends there."""


class Assembler:
    """Makes samples of the messages of one log, as they come.

    Feed it many messages at once (thousands): it works on columns. The same messages make the same samples
    however they are handed over.

    Args:
        name: of the log, for what is told.
        decoder: how the messages of a topic are decoded.
        start_ns, end_ns: only samples from `start_ns` up to, not including, `end_ns` come out; messages
            before and after may be fed, and count for them.
    """

    def __init__(
        self,
        plan: Plan,
        decoder: Callable[[str], Decoder],
        *,
        name: str,
        start_ns: int | None = None,
        end_ns: int | None = None,
        on_time_jump: OnTimeJump = "error",
        concave: Concave = "decompose",
    ) -> None:
        raise NotImplementedError

    @property
    def is_finished(self) -> bool:
        """Whether no further message can change anything: after a jump that splits, or past the end."""
        raise NotImplementedError

    def add(self, messages: Sequence[Message]) -> Trace:
        """Take messages in the order of the log; the samples that are final now, maybe none.

        Raises:
            LogError: time jumps back by more than a second, and `on_time_jump` is "error".
            UsageError: the mapping does not fit what the messages hold.
        """
        raise NotImplementedError

    def finish(self) -> Trace:
        """The samples that are left when the log has ended."""
        raise NotImplementedError

    def take_faults(self) -> tuple[str, ...]:
        """What was lost since the last call, each with its place."""
        raise NotImplementedError

    def take_remarks(self) -> tuple[str, ...]:
        """What is not as one would wish, without a loss: counts of stale objects, missing transforms."""
        raise NotImplementedError
