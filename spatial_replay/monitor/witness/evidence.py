"""The samples that an instance was evaluated over, to be looked at again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.channels import in_channels
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.leaves import leaf_values
from spatial_replay.monitor.operands import Scene
from spatial_replay.monitor.stream import look_back, tail
from spatial_replay.spec.formula import Formula, Outline, TrackedName
from spatial_replay.spec.terms import substitute
from spatial_replay.trace.trace import Trace, window_of


class Evidence:
    """The samples of one instance, read again whenever something is asked about them."""

    def __init__(
        self, instance: Instance, regions: Mapping[str, Outline], traces: Callable[[], Iterable[Trace]]
    ) -> None:
        """
        Args:
            traces: begins the samples anew, from what may be looked back at, in stretches of any length.
        """
        self.instance = instance
        self._regions = regions
        self._traces = traces
        self._reach = look_back([instance.formula])

    def bound(self, formula: Formula) -> Formula:
        """A formula of the instance, with the object that it is about in place of its variable."""
        return substitute(
            formula, {variable: TrackedName(name) for variable, name in self.instance.bindings.items()}
        )

    def scene(self, time_ns: int) -> Scene:
        """The one sample of that time, with those before it that it may look back at.

        Raises:
            LookupError: there is none; the log changed since it was evaluated.
        """
        for scene in self._scenes():
            trace = scene.trace
            at, end = window_of(trace.times_ns, time_ns, time_ns + 1)
            if at < end:
                past = tail(trace.slice(0, at), *self._reach) if at else trace.slice(0, 0)
                return Scene(Trace.concatenate([past, trace.slice(at, end)]), self._regions, len(past))
        raise LookupError(f"there is no sample at {time_ns} ns any more")

    def columns(self, formulas: Sequence[Formula]) -> Floats:
        """(C, K, T): what K formulas without temporal operators are in each sample (see `leaf_values`)."""
        parts: list[Floats] = []
        for scene in self._scenes():
            times_ns = scene.trace.times_ns[scene.skip :]
            begin, end = window_of(times_ns, self.instance.start_ns, self.instance.end_ns)
            parts.append(leaf_values(scene, formulas, self.instance.bindings)[:, :, begin:end])
        channels = max(map(len, parts))
        return np.concatenate([in_channels(part, channels) for part in parts], axis=2)

    def _scenes(self) -> Iterator[Scene]:
        """The samples, in stretches, each with what it may look back at."""
        past: Trace | None = None
        for trace in self._traces():
            skip = 0
            if past is not None and self._reach != (0, 0):
                recent = tail(past, *self._reach)
                skip = len(recent)
                trace = Trace.concatenate([recent, trace])
            past = trace if len(trace) else past
            yield Scene(trace, self._regions, skip)
