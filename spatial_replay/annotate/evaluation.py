"""Evaluations of specifications over samples, with the messages of an annotated log.

The encoders are imported with the first message, so that an evaluation without messages imports no encoder.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from spatial_replay.annotate.specification import reported_trees
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.messages import Attachment, Channel
from spatial_replay.logs.topics import AUTOMATON, DERIVED, SCENE
from spatial_replay.monitor.stream import EvaluationStream, Instance, SeriesBlock
from spatial_replay.monitor.verdict import Semantics
from spatial_replay.spec.formula import Specification
from spatial_replay.text import listing, nearest_hint
from spatial_replay.trace.trace import Trace
from spatial_replay.trace.units import OUR_AXES, Axes

if TYPE_CHECKING:
    from spatial_replay.annotate.annotator import Annotator
    from spatial_replay.annotate.automaton_state import SpecAutomaton
    from spatial_replay.annotate.foxglove_layout import LayoutContents
    from spatial_replay.annotate.scene.extent import SceneBounds
    from spatial_replay.annotate.scene.scene_frames import SceneFrames
    from spatial_replay.annotate.scene.scene_update import SceneState

_MOST_NAMED: Final = 10
"""Limit of results in an error."""


class AnnotatedEvaluation:
    """An evaluation of specifications, block by block, with the messages of an annotated log.

    Numbers and messages do not depend on the cut of samples into blocks.

    Attributes:
        trees: reported trees of all results.
        streams: evaluation of each tree.
    """

    def __init__(
        self,
        files: Sequence[Specification],
        instances: Sequence[Sequence[Instance]],
        semantics: Semantics = "ltlf",
        compiled_before: Callable[[], Sequence[Attachment]] = list,
        known: Sequence[SpecAutomaton] = (),
        show: Callable[[SceneFrames], None] = lambda frames: None,
        arrow: str = "",
        units: Mapping[str, str] = MappingProxyType({}),
        plan: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Start before the first sample.

        Args:
            instances: instances to evaluate, by file.
            compiled_before: returns attachments of a log; automata in them replace compilations with MONA.
            known: compiled automata of specs in these files.
            show: function that receives the frames of the scene.
            arrow: title of the result whose violation has the arrow; "" for the first violated result.
            units: declared units, see `unit_of`.
            plan: metadata of the log's plan; the scene's extent includes the plan's map.

        Raises:
            UsageError: no result has the title `arrow`.
        """
        self._files = files
        self._semantics = semantics
        self._compiled_before = compiled_before
        self._known = known
        self._show = show
        self._arrow, self.units, self._plan = arrow, units, plan

        self._evaluations = [
            EvaluationStream(file_instances, file.regions, semantics)
            for file_instances, file in zip(instances, files, strict=True)
        ]
        self.streams = [stream for evaluation in self._evaluations for stream in evaluation.streams]
        self.trees = reported_trees(files, instances)
        self.check_arrow(arrow)

    def check_arrow(self, title: str) -> None:
        """Check that a result has the title, or that the title is "".

        Raises:
            UsageError: no result has the title.
        """
        if title and not any(tree.is_called(title) for tree in self.trees):
            titles = [tree.title for tree in self.trees]
            hint = nearest_hint(title, titles) or f"the results are: {listing(titles, _MOST_NAMED)}"
            raise UsageError(f"there is no result {title!r} for the arrow to point at; {hint}")

    def extend(self, trace: Trace) -> list[SeriesBlock]:
        """Evaluate the next samples, and return one block per tree."""
        return [block for evaluation in self._evaluations for block in evaluation.extend(trace)]

    @property
    def finals(self) -> list[Floats]:
        """For each tree, (N, 2), lower and upper end of each node's value if the log ends now."""
        return [stream.final for stream in self.streams]

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels of the messages that annotate samples."""
        from spatial_replay.annotate.annotator import channels_of_results

        return channels_of_results(self.trees)

    def contents(
        self,
        extent: SceneBounds | None,
        topics: Collection[str] = (),
        axes: Axes = OUR_AXES,
        images: Collection[str] = (),
    ) -> LayoutContents:
        """Return the contents of an annotated log that the log's layout shows.

        Args:
            extent: bounds of all footprints; None without footprints.
            topics: topics of messages that are not derived from samples.
            axes: axes of the source.
            images: topics with images.
        """
        from spatial_replay.annotate.annotator import shown_regions
        from spatial_replay.annotate.foxglove_layout import LayoutContents
        from spatial_replay.annotate.scene.scene_template import outlines_of
        from spatial_replay.monitor.atoms.terms import footprint_from_outline

        if extent is not None:
            outlines = map(footprint_from_outline, shown_regions(self._files).values())
            for ring in (ring for outline in outlines for ring in outlines_of(outline)):
                extent = extent.with_points(ring)
        has_states = [spec_automaton.automaton is not None for spec_automaton in self.automata]
        # every result has events: a verdict is reported when it is reached, or else when the log ends
        derived_topics = {SCENE, *(DERIVED if self.trees else ())} - set(
            () if any(has_states) else (AUTOMATON,)
        )
        return LayoutContents(
            self.trees,
            has_states,
            extent,
            derived_topics | set(topics),
            axes,
            images=sorted(images),
            units=self.units,
        )

    def layout(
        self,
        topics: Collection[str] = (),
        axes: Axes = OUR_AXES,
        images: Collection[str] = (),
        planned_for: str = "",
        start: tuple[int, str] = (0, ""),
        planned: str = "",
    ) -> Attachment:
        """Return the layout for viewers of the log. Encode all messages before the call.

        Args:
            topics: topics of messages that are not derived from samples.
            axes: axes of the source.
            images: topics with images.
            planned_for: specification file of the decisions, if these results are of another file; else "".
            start: time of the first message in a viewer, and name of the log with that message.
            planned: name of the result that a planner worked for; "" without a plan.
        """
        from spatial_replay.annotate.foxglove_layout import TextZero, layout_attachment

        extent, standing_encoder = self.annotator.extent, self.annotator.standing
        contents = self.contents(extent, topics, axes, images)
        contents = contents._replace(planned_for=planned_for, planned=planned)
        if not self.annotator.has_samples:
            return layout_attachment(contents._replace(has_states=[False] * len(self.trees), topics=topics))
        text_zero = TextZero(self.annotator.scene.zero_ns or 0, *start)
        return layout_attachment(
            contents._replace(
                outcomes=standing_encoder.outcomes,
                order=standing_encoder.order,
                zero=text_zero,
                first_event_ns=self.annotator.first_event_ns,
            )
        )

    @cached_property
    def automata(self) -> Sequence[SpecAutomaton]:
        """The automata of the trees, compiled on first use, because only logs and viewers need them."""
        from spatial_replay.annotate.automaton_state import automata_of

        return automata_of(self._files, self.trees, self._semantics, self._compiled_before(), self._known)

    def new_annotator(
        self,
        scene: SceneState | None = None,
        arrow: str = "",
        show: Callable[[SceneFrames], None] | None = None,
    ) -> Annotator:
        """Return an annotator that starts before the first sample.

        Args:
            scene: state of a viewer that continues with these messages; None for a new viewer.
            arrow: title of the result whose violation has the arrow; "" for the first violated result.
            show: function that receives the frames of the scene; None for the evaluation's own.
        """
        from spatial_replay.annotate.annotator import Annotator

        instances = [stream.instance for stream in self.streams]
        return Annotator(
            self._files,
            self.trees,
            instances,
            self.automata,
            self._semantics,
            scene,
            show or self._show,
            arrow,
            self.units,
        )

    @cached_property
    def annotator(self) -> Annotator:
        """The encoder of the log's messages. Pass each block of `extend` to it, with the block's samples."""
        annotator = self.new_annotator(arrow=self._arrow)
        annotator.add_map(self._plan)
        return annotator
