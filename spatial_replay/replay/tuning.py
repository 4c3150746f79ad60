"""Specifications evaluated over a log again and again, each time with other values for their constants."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import PurePath
from types import MappingProxyType
from typing import Final

from spatial_replay.annotate.annotator import AnnotatedEvaluation, Annotator
from spatial_replay.annotate.curves import CurvedResult, encode_curves
from spatial_replay.annotate.foxglove_layout import Extent, live_layout_attachment
from spatial_replay.annotate.scene_update import SceneState
from spatial_replay.annotate.specification import kept_files
from spatial_replay.errors import UsageError
from spatial_replay.logs.messages import Attachment
from spatial_replay.logs.source import MemorySource, Source
from spatial_replay.monitor.semantics import Semantics, checked_semantics
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.monitor.verdict import Verdict, worst_verdict
from spatial_replay.monitor.witness.path import Evidence
from spatial_replay.replay.engine import Replayed, ReplayedSpec, replayed_spec
from spatial_replay.replay.selection import OwnMessages, Selection, Window, first_sample_ns
from spatial_replay.spec import parse_specification
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.format import format_duration
from spatial_replay.spec.formula import Constant, Specification, iter_nodes
from spatial_replay.trace.trace import Trace

MOST_NUMBERS: Final = 1 << 27
"""Numbers of nodes at samples, four for each, that an evaluation may have: 1 GiB of them."""


class Tuning:
    """A log in memory, with the specifications whose constants are changed.

    What is measured between footprints is kept, so that a change measures only what it brings in.

    Attributes:
        constants: those of the specifications, as they are written, by the names to change them by.
        trace: every sample that counts, those that are only looked back at included.
        inside: those in the window.
        own: the messages of the log itself.
        semantics: what the formulas mean.
        faults, remarks: what was lost while reading, and what else the source says.
    """

    def __init__(
        self,
        source: Source,
        files: Sequence[Specification],
        *,
        window: Window | None = None,
        each: Mapping[str, str] | None = None,
        semantics: Semantics = "ltlf",
        advance: Callable[[int], None] = lambda samples: None,
    ) -> None:
        """Read the log.

        Args:
            window, each, semantics: as for a replay.
            advance: told how many more samples are read.

        Raises:
            LogError: no sample in the log, or it cannot be read.
            UsageError: no sample in the window, an operator that the semantics lacks.
            SpecificationError: names that the log never has.
        """
        self.semantics = checked_semantics(semantics, files)
        self._source, self._each = source, dict(each or {})
        self._files = tuple(files)
        selection = Selection(source, window or Window(), self._files)
        self.window = selection.window
        self.own = OwnMessages(selection)
        traces: list[Trace] = []
        remarks: list[str] = []
        for block, trace in selection.iter_blocks():
            traces.append(trace)
            remarks += block.remarks
            self.own.add(block)
            advance(len(trace))
        self.trace = Trace.concatenate(traces)
        self.faults, self.remarks = tuple(self.trace.faults), tuple(dict.fromkeys(remarks))
        self.inside = selection.inside(self.trace)
        if not len(self.inside):
            raise selection.nothing_to_evaluate(self.faults)
        selection.check_names(self.trace.names, tuple(self.trace.signals))
        self.first_ns = first_sample_ns(source) if self.window.start_ns else int(self.trace.times_ns[0])
        self._places = _places(self._files)
        self.constants: Mapping[str, Constant] = self._constants(self._files)

    @property
    def name(self) -> str:
        """The log's name."""
        return self._source.name

    def specifications(self, changed: Mapping[str, float | str]) -> list[Specification]:
        """The specifications with other values for some constants, as `evaluate` takes them.

        Raises:
            UsageError: no such constant, a value of another kind.
            SpecificationError: a specification that means nothing with these values.
        """
        values = [dict[str, float | str]() for _ in self._files]
        for name, value in changed.items():
            file, own = self._place(name, value)
            values[file][own] = value
        return [_with_constants(file, own) for file, own in zip(self._files, values, strict=True)]

    def evaluate(self, changed: Mapping[str, float | str] | None = None) -> Tuned:
        """The specifications over all samples, with other values for some constants.

        Args:
            changed: numbers and, as texts, durations ("2s"), by name; the others stay as they are written.

        Raises:
            UsageError: no such constant, a value of another kind, more numbers than are held at once.
            SpecificationError: a specification that means nothing with these values.
        """
        files = self.specifications(changed or {})
        held = Selection(MemorySource(self.trace, self.name), replace(self.window, every=1), files)
        kept = kept_files(files)
        instances = [held.instances(file, self._each) for file in kept]
        evaluation = AnnotatedEvaluation(kept, instances, self.semantics, self._source.attachments)
        self._check_size(evaluation)
        return Tuned(
            self, tuple(kept), self._constants(files), evaluation, tuple(evaluation.extend(self.trace)), held
        )

    def replayed(self, results: Sequence[ReplayedSpec]) -> Replayed:
        """Results as those of a replay; without a certificate, which nobody asks of what is only tried."""
        times_ns = self.inside.times_ns
        return Replayed(
            log=self.name,
            samples=len(self.inside),
            first_ns=self.first_ns,
            start_ns=int(times_ns[0]),
            end_ns=int(times_ns[-1]),
            faults=self.faults,
            remarks=self.remarks,
            unreadable=self.inside.unreadable_count,
            results=tuple(results),
            certificate=MappingProxyType({}),
            semantics=self.semantics,
        )

    def _constants(self, files: Sequence[Specification]) -> Mapping[str, Constant]:
        return MappingProxyType(
            {name: files[file].constants[own] for name, (file, own) in self._places.items()}
        )

    def _place(self, name: str, value: object) -> tuple[int, str]:
        """The file of a constant, and its name there, if a value is of its kind."""
        if name not in self._places:
            known = tuple(self._places)
            hint = nearest_hint(name, known) or f"the constants are: {', '.join(known) or 'none'}"
            raise UsageError(f"there is no constant {name!r} to change; {hint}")
        written = self.constants[name]
        if isinstance(value, str) != (written.duration_ns is not None):
            kind = "a number" if written.duration_ns is None else "a duration, given as a text such as '2s'"
            raise UsageError(
                f"{name} cannot be {value!r}: it is {kind} ({constant_text(written)} as written)"
            )
        return self._places[name]

    def _check_size(self, evaluation: AnnotatedEvaluation) -> None:
        nodes = sum(1 for tree in evaluation.trees for _ in iter_nodes(tree.formula))
        numbers = 4 * nodes * len(self.inside)
        if numbers > MOST_NUMBERS:
            raise UsageError(
                f"{nodes} nodes at {len(self.inside)} samples are {numbers} numbers, more than the "
                f"{MOST_NUMBERS} that are held at once; narrow the window with --from and --to, or keep "
                "every Nth sample with --every"
            )


@dataclass(frozen=True, eq=False)
class Tuned:
    """Every number that the specifications have with some values for their constants.

    Attributes:
        files: the specifications with these values, as a log keeps them.
        constants: the values, by the names of `Tuning.constants`.
        evaluation: what was evaluated.
        stretches: for each of its trees, every sample.
    """

    tuning: Tuning
    files: tuple[Specification, ...]
    constants: Mapping[str, Constant]
    evaluation: AnnotatedEvaluation
    stretches: tuple[SeriesBlock, ...]
    selection: Selection

    @property
    def verdict(self) -> Verdict:
        """The worst of the results'."""
        return worst_verdict(stream.verdict for stream in self.evaluation.streams)

    @cached_property
    def replayed(self) -> Replayed:
        """The results, to be shown and inquired into as those of a replay."""
        return self.tuning.replayed(
            [
                replayed_spec(
                    tree,
                    stream,
                    Evidence(stream.instance, self.files[tree.file].regions, self.selection.iter_traces),
                    stretch,
                    self.tuning.semantics,
                    has_series=True,
                    has_leaves=True,
                )
                for tree, stream, stretch in zip(
                    self.evaluation.trees, self.evaluation.streams, self.stretches, strict=True
                )
            ]
        )

    @cached_property
    def curves(self) -> bytes:
        """The message of /spatial/curves."""
        results = [
            CurvedResult(tree, stretch, float(stream.robustness[0]), *stream.final[0].tolist())
            for tree, stream, stretch in zip(
                self.evaluation.trees, self.evaluation.streams, self.stretches, strict=True
            )
        ]
        return encode_curves(self.tuning.inside.times_ns, results, self.tuning.first_ns)

    @cached_property
    def layout(self) -> Attachment:
        """How to open a server of this log in a viewer."""
        topics = {each.topic for each in self.tuning.own.channels}
        return live_layout_attachment(self.evaluation.contents(Extent.of(self.tuning.inside), topics))

    def annotator(self, scene: SceneState | None = None) -> Annotator:
        """Who writes the messages of these samples, from the first on; see `AnnotatedEvaluation`."""
        return self.evaluation.annotator(scene)

    def part(self, begin: int, end: int) -> tuple[Trace, list[SeriesBlock]]:
        """Samples `begin` to before `end` of those in the window, and what the evaluation says of them."""
        trace = self.tuning.inside.slice(begin, end)
        if not len(trace):
            return trace, [stretch.between(0, 0) for stretch in self.stretches]
        first_ns, last_ns = trace.times_ns[[0, -1]].tolist()
        return trace, [stretch.between(first_ns, last_ns + 1) for stretch in self.stretches]


def constant_text(constant: Constant) -> str:
    """A constant as a specification writes it: `70`, `2s`."""
    if constant.duration_ns is not None:
        return format_duration(constant.duration_ns)
    return repr(constant.value).removesuffix(".0")


def values_of(constants: Mapping[str, Constant]) -> dict[str, float | str]:
    """Constants as `Tuning.evaluate` takes them."""
    return {
        name: each.value if each.duration_ns is None else constant_text(each)
        for name, each in constants.items()
    }


def _places(files: Sequence[Specification]) -> dict[str, tuple[int, str]]:
    """For each constant its file and its name there; where two files share a name, after their stems."""
    names = [name for file in files for name in file.constants]
    return {
        f"{PurePath(file.filename).stem}.{name}" if names.count(name) > 1 else name: (index, name)
        for index, file in enumerate(files)
        for name in file.constants
    }


def _with_constants(file: Specification, values: Mapping[str, float | str]) -> Specification:
    if not values:
        return file
    return parse_specification(file.source, filename=file.filename, profile=file.profile, constants=values)
