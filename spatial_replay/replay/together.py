"""Replays of many logs with one plan. Short logs are measured together, but each log has its results."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from spatial_replay.annotate.specification import reported_trees
from spatial_replay.logs.source import Source
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.stream import InstanceStream, SeriesBlock, one_after_another, run_together
from spatial_replay.replay.engine import LogAccount, Replayed, ReplayPlan, replayed_specs
from spatial_replay.replay.selection import (
    DEFAULT_OPTIONS,
    ReplayOptions,
    Selection,
    log_zero_ns,
    look_before,
)
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.trace import Trace

_MOST_SAMPLES: Final = 2**12
"""Maximum number of samples of a log that is measured together with other logs."""
_MOST_BYTES: Final = 2**22
"""Maximum size of a log that is measured together with other logs, bytes."""
_ENOUGH_SAMPLES: Final = 2**14
"""Number of samples above which no log is added to the logs that are measured together."""
_ENOUGH_BYTES: Final = 2**25
"""Size above which no log is added to the logs that are measured together, bytes."""


@dataclass(frozen=True, eq=False)
class ShortLog:
    """A log in memory, with its account.

    Attributes:
        zero_ns: zero of times in sentences.
        samples: number of evaluated samples, including samples that fill pauses.
        nbytes: size of the samples, bytes.
    """

    selection: Selection
    traces: Sequence[Trace]
    account: LogAccount
    zero_ns: int
    samples: int
    nbytes: int


class JointReplay:
    """Replays of the same specifications over many logs with the same units.

    The results are identical to the results of `Replay` with `keep_leaves`, to the last bit.

    Attributes:
        trees: formula tree and reported name of each result.
    """

    def __init__(
        self, source: Source, files: Sequence[Specification], options: ReplayOptions = DEFAULT_OPTIONS
    ) -> None:
        """Prepare the specifications.

        Args:
            source: one of the logs. All logs need the units of this log.

        Raises:
            UsageError: see `Selection`.
        """
        self._selection = Selection(source, files, options)
        self._plan = ReplayPlan.of(self._selection)
        self.trees = reported_trees(self._plan.files, self._plan.instances)
        self._units = source.axes.units

    def fits(self, source: Source) -> bool:
        """Return whether a log has the units of the other logs."""
        return source.axes.units == self._units

    def read(self, source: Source) -> ShortLog | None:
        """Read a log into memory. The result is None if the log is too long.

        Raises:
            LogError, UsageError: the log cannot be read, or has no sample.
        """
        selection, account = self._selection.over(source), LogAccount(self._plan)
        run_ends = selection.run_ends()
        traces: list[Trace] = []
        sample_count = nbytes = 0
        for block, trace in selection.read_blocks(messages=False, ends=run_ends):
            sample_count, nbytes = sample_count + len(trace), nbytes + trace.nbytes
            if sample_count > _MOST_SAMPLES or nbytes > _MOST_BYTES:
                return None
            account.add(block, trace)
            traces.append(trace)
        account.check_samples(selection)
        zero_ns = log_zero_ns(source, selection.window, run_ends)
        return ShortLog(selection, traces, account, zero_ns, sample_count, nbytes)

    def is_enough(self, logs: Collection[ShortLog]) -> bool:
        """Return whether more logs would take too much memory."""
        return (
            sum(log.samples for log in logs) > _ENOUGH_SAMPLES
            or sum(log.nbytes for log in logs) > _ENOUGH_BYTES
        )

    def replay(self, logs: Sequence[ShortLog]) -> Iterator[Replayed]:
        """Evaluate short logs, and yield the results of each log.

        Raises:
            SpecificationError: a name is missing in a log, and names are strict.
        """
        traces = [log.traces[0] if len(log.traces) == 1 else Trace.concatenate(log.traces) for log in logs]
        joined_trace, semantics = one_after_another(traces), self._selection.options.semantics
        runs_by_file = [
            run_together(instances, TraceScene(joined_trace, file.regions), traces, semantics)
            for instances, file in zip(self._plan.instances, self._plan.files, strict=True)
        ]
        for log, *runs_of_log in zip(logs, *runs_by_file, strict=True):
            streams = [stream for streams, _ in runs_of_log for stream in streams]
            blocks = [block for _, blocks in runs_of_log for block in blocks]
            yield self._log_result(log, streams, blocks)

    def _log_result(
        self, log: ShortLog, streams: Sequence[InstanceStream], blocks: Sequence[SeriesBlock]
    ) -> Replayed:
        results = replayed_specs(
            streams,
            self.trees,
            self._plan.files,
            blocks,
            lambda: iter(log.traces),
            log.zero_ns,
            units=self._units,
            has_series=False,
            doubts=log.account.doubts(log.zero_ns),
        )
        return log.account.summary(log.selection, log.zero_ns, results)


def can_join(files: Sequence[Specification], options: ReplayOptions) -> bool:
    """Return whether specifications can be measured over many logs at once.

    A window, a template or a term that looks back rules out joint measurement. Templates have different
    instances in each log, and terms that look back need earlier samples.
    """
    has_templates = any(spec.parameter is not None for file in files for spec in file.results)
    return options.window.is_whole and not has_templates and not look_before(files)
