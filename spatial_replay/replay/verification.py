"""Certificates of logs, compared with those that a new evaluation gives."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from spatial_replay.annotate.certificate import PLAN_SHA256, plan_sha256
from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.mcap.read import McapSource
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import CERTIFICATE, METADATA, PLAN_METADATA
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.replay.annotated import load_files, run_replay
from spatial_replay.replay.clipped_source import CLIP_METADATA, clipped_source
from spatial_replay.replay.engine import Replay
from spatial_replay.replay.first_differences import FirstDifferences, explain_differences
from spatial_replay.replay.kept_messages import KEEP_ALL
from spatial_replay.replay.selection import ReplayOptions, Window
from spatial_replay.spec.formula import Specification
from spatial_replay.text import Sentence, counted_from

_HASHES: Mapping[str, str] = MappingProxyType(
    {
        "samples_sha256": "other samples",
        "messages_sha256": "other messages",
        "specification_sha256": "another specification",
        "results_sha256": "other results",
        PLAN_SHA256: "other plan settings",
    }
)
"""The meaning of a difference, for each hash of a certificate."""

_NOT_COVERED = (
    "plan settings are not covered by this certificate; --decisions recomputes what followed from them"
)
_NO_PLAN = "no plan settings: the log was planned, and its decisions cannot be recomputed without"

_READING = ("on_time_jump", "late", "max_gap", "rate", "lost", "y_down", "concave")
_WINDOW = ("start_ns", "end_ns", "every")


@dataclass(frozen=True, slots=True)
class Verified:
    """A certificate as recorded, and as computed now.

    Attributes:
        recorded: the log's certificate; empty where it has none.
        computed: the one of the new evaluation.
        faults: what could not be read.
        explanation: for each part of the certificate whether it is the same, and where it differs first;
            empty unless it was asked for.
        lacks_plan: whether the log says that it was planned, and neither has settings nor was certified with
            any.
        notes: what the certificate does not cover, as sentences.
    """

    recorded: Mapping[str, str]
    computed: Mapping[str, str]
    faults: tuple[str, ...] = ()
    explanation: tuple[str, ...] = ()
    lacks_plan: bool = False
    notes: tuple[str, ...] = ()

    @property
    def differences(self) -> tuple[str, ...]:
        """The differences in words; none if everything is equal."""
        if not self.recorded:
            return ("the log has no certificate: it was not written to its end",)
        found = [
            f"{what}: {self.computed.get(key, 'nothing')} now, {self.recorded.get(key, 'nothing')} recorded"
            for key, what in _HASHES.items()
            if self.recorded.get(key) != self.computed.get(key)
            # certificates of before have no hash of the settings
            and not (key == PLAN_SHA256 and key not in self.recorded)
        ]
        return (*found, *([_NO_PLAN] if self.lacks_plan else []))


def verify_certificate(
    log: Source,
    source: Source | None = None,
    advance: Callable[[int], None] = lambda samples: None,
    *,
    explain: bool = False,
) -> Verified:
    """Evaluate a log, or its source, again with the log's own specifications and options.

    Args:
        source: the log that it was made from; None evaluates the log itself.
        advance: called with the number of samples of each block that is done.
        explain: say where a certificate that differs does so first, which takes another evaluation.

    Raises:
        UsageError, LogError, SpecificationError: it cannot be evaluated.
    """
    metadata = dict(log.metadata())
    recorded, about = metadata.get(CERTIFICATE, {}), metadata.get(METADATA, {})
    if not recorded:
        return Verified({}, {})
    options = _options(about)
    if source is None and options.get("layer"):
        raise UsageError(
            f"{log.name} is a layer without samples; give the log that it was made from: --source SOURCE"
        )
    keep = None if source is None else _kept(about, options)
    clip = metadata.get(CLIP_METADATA, {})
    # a replay of a clip has its record, too, but was made from all of the clip
    if source is not None and clip and clip.get("source") == about.get("source"):
        source, keep = clipped_source(source, clip), None
    evaluated = log if source is None else source
    chosen = ReplayOptions(
        Window(**{name: options[name] for name in _WINDOW if name in options}),
        options.get("each", {}),
        _semantics(about),
        keep=keep,
        arrow=str(options.get("arrow", "")),
    )
    replayed = run_replay(evaluated, _files(log), chosen, advance=advance)
    computed = dict(replayed.certificate)
    plan = metadata.get(PLAN_METADATA)
    if not options.get("layer") and recorded.get(PLAN_SHA256) == computed.get(PLAN_SHA256):
        # its source has those that were certified; the log's own copy of them counts, too
        computed |= {} if plan is None else {PLAN_SHA256: plan_sha256(plan)}
        if plan is None:
            computed.pop(PLAN_SHA256, None)
    lacks_plan = about.get("planned") == "true" and plan is None and PLAN_SHA256 not in recorded
    lacks_plan = lacks_plan and not options.get("layer")
    is_covered = plan is None or PLAN_SHA256 in recorded
    notes = () if is_covered else (_NOT_COVERED,)
    verified = Verified(dict(recorded), computed, replayed.faults, lacks_plan=lacks_plan, notes=notes)
    if not explain:
        return verified
    found: Mapping[str, Sentence] = {}
    if verified.differences and isinstance(log, McapSource):
        compared = FirstDifferences(log.path)
        Replay(evaluated, _files(log), chosen, certify=False).run(
            compared.add, layer=bool(options.get("layer")), advance=advance
        )
        found = compared.finish()
    explanation = explain_differences(verified.recorded, verified.computed, found)
    return replace(verified, explanation=counted_from(explanation, replayed.first_ns))


def recorded_reading(log: Source, source: str) -> dict[str, Any]:
    """Return the options with which a log's source was read, such as the rate of its frames.

    Args:
        source: the name of the file that is given as the source; no option applies to another one.
    """
    about = dict(log.metadata()).get(METADATA, {})
    if about.get("source") != source:
        return {}
    try:
        options = json.loads(about.get("options", "{}"))
    except ValueError:
        return {}
    return {name: options[name] for name in _READING if name in options} if isinstance(options, dict) else {}


def _files(log: Source) -> list[Specification]:
    """Return the specifications that a log was written with, if any."""
    try:
        return load_files((), log)
    except UsageError:
        return []


def _options(about: Mapping[str, str]) -> dict[str, Any]:
    """Return the options of the replay that wrote a log; none for a recording."""
    if about.get("written_by") != "replay":
        return {}
    try:
        options = json.loads(about.get("options", "{}"))
    except ValueError as error:
        raise LogError(f"the options in the log's metadata cannot be read: {error}") from error
    return options if isinstance(options, dict) else {}


def _kept(about: Mapping[str, str], options: Mapping[str, Any]) -> tuple[str, ...] | None:
    """Return which messages of its source a log kept: none in a recording, all in a copy by default."""
    if about.get("written_by") != "replay":
        return ()
    return None if options.get("layer") else tuple(options.get("keep", KEEP_ALL))


def _semantics(about: Mapping[str, str]) -> Semantics:
    return "paper" if about.get("semantics") == "paper" else "ltlf"
