"""Specifications evaluated over samples, with all that a log says of that."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import PurePath

from spatial_replay.errors import SpecificationError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.inspection.annotator import Annotator
from spatial_replay.inspection.automata import (
    KeptAutomaton,
    automata_attachments,
    automata_metadata,
    automata_of,
)
from spatial_replay.inspection.scene import SceneState
from spatial_replay.inspection.specification import reported_trees
from spatial_replay.inspection.viewer import layout_attachment
from spatial_replay.logs.block import Messages
from spatial_replay.logs.merging import merge
from spatial_replay.logs.sink import Attachment
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.semantics import Semantics, instance_evaluation
from spatial_replay.monitor.stream import EvaluationStream, Stretch
from spatial_replay.spec import format_specification, parse_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.trace import Trace


class AnnotatedEvaluation:
    """Specifications evaluated over samples as they come, with the messages that say so.

    Into how many stretches the samples are cut changes neither numbers nor messages.

    Attributes:
        trees: every result, under the name it is reported by.
        streams: their evaluation, in the same order.
    """

    def __init__(
        self,
        files: Sequence[Specification],
        instances: Sequence[Sequence[Instance]],
        semantics: Semantics = "ltlf",
        compiled_before: Callable[[], Sequence[Attachment]] = list,
        known: Sequence[KeptAutomaton] = (),
    ) -> None:
        """Start before the first sample.

        Args:
            instances: what to evaluate of each file.
            compiled_before: gives the attachments of a log; automata among them need no MONA.
            known: automata of specs of these files, which are not compiled again.
        """
        self._files = files
        self._semantics = semantics
        self._compiled_before = compiled_before
        self._known = known
        begin = partial(instance_evaluation, semantics=semantics)
        self._evaluations = [
            EvaluationStream(own, file.regions, begin) for own, file in zip(instances, files, strict=True)
        ]
        self.streams = [stream for evaluation in self._evaluations for stream in evaluation.streams]
        self.trees = reported_trees(files, instances)

    def extend(self, trace: Trace) -> list[Stretch]:
        """Take in the next samples; one stretch for each of `trees`."""
        return [stretch for evaluation in self._evaluations for stretch in evaluation.extend(trace)]

    def messages(self, trace: Trace, stretches: Sequence[Stretch]) -> list[Messages]:
        """What to write beside samples, from the stretches that `extend` gave for them."""
        return self._annotator.messages(trace, stretches)

    @property
    def finals(self) -> list[Floats]:
        """For each of `trees` (N, 2), lower and upper end of each node's value if the log ends here."""
        return [stream.final for stream in self.streams]

    def end(self, time_ns: int) -> Messages:
        """What to write after everything else of a log.

        Args:
            time_ns: that of its last sample or message, whichever is later.
        """
        return merge(self._annotator.end(time_ns, self.finals))

    def layout(self, beside: Collection[str] = ()) -> Attachment:
        """How to open the log in a viewer, once everything else is written.

        Args:
            beside: topics of messages of others in it.
        """
        return layout_attachment(self._annotator.contents(beside))

    def automata_metadata(self) -> Mapping[str, str]:
        """For each spec, how large its automaton is, or why there is none."""
        return automata_metadata(self.automata)

    def automata_attachments(self, prefix: str) -> list[Attachment]:
        """The automata, to be kept beside the specifications of `specification_attachments`."""
        return automata_attachments(self.automata, prefix)

    @cached_property
    def automata(self) -> Sequence[KeptAutomaton]:
        """Of each tree; compiled when first asked for, since not every evaluation is written down."""
        return automata_of(self._files, self.trees, self._semantics, self._compiled_before(), self._known)

    def annotator(self, scene: SceneState | None = None) -> Annotator:
        """Who writes what is to be said of the samples, from the first on.

        Args:
            scene: what a viewer shows already, if it goes on with it.
        """
        instances = [stream.instance for stream in self.streams]
        return Annotator(self._files, self.trees, instances, self.automata, self._semantics, scene)

    @cached_property
    def _annotator(self) -> Annotator:
        return self.annotator()


def kept_files(files: Sequence[Specification]) -> list[Specification]:
    """The specifications as a log keeps them, so that who reads it back gets equal ones of equal names.

    Each has a file name whose stem no other has. A text that would not be read back as the same specification
    (it was parsed with a profile or constants of its own) gives way to the canonical one.
    """
    kept: list[Specification] = []
    stems: set[str] = set()
    for file in files:
        path = PurePath(file.filename)
        own, suffix = path.stem.strip("<>"), path.suffix or ".spatial"
        stem, count = own, 1
        while stem in stems:
            count += 1
            stem = f"{own}-{count}"
        stems.add(stem)
        kept.append(replace(_self_contained(file), filename=f"{stem}{suffix}"))
    return kept


def specification_attachments(files: Sequence[Specification], prefix: str) -> list[Attachment]:
    """The texts of `kept_files`, to be kept in a log under names that begin with `prefix`."""
    return [Attachment(f"{prefix}{file.filename}", "text/plain", file.source.encode()) for file in files]


def _self_contained(file: Specification) -> Specification:
    for text in (file.source, format_specification(file)):
        try:
            read_back = parse_specification(text, filename=file.filename)
        except SpecificationError:
            continue
        if read_back == file:
            return file if text == file.source else read_back
    # relations given in Python cannot be written down
    return file
