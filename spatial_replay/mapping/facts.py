"""Facts of each mapped topic: its evidence in, frozen values for users out."""

from __future__ import annotations

import math

from spatial_replay.mapping.evidence import Spread, TopicEvidence
from spatial_replay.trace.facts import Distribution, TopicFacts


def facts_of(evidence: TopicEvidence) -> TopicFacts:
    """Return the facts of a topic after all of its messages have been measured."""
    arrivals, motions, planned = evidence.arrivals, evidence.motions, evidence.planned
    extractor = evidence.reader.extractor
    classes = {evidence.classes.by_code[code] for code in evidence.class_codes}
    return TopicFacts(
        topic=evidence.reader.name,
        messages=arrivals.messages,
        first_ns=arrivals.first_ns,
        last_ns=arrivals.last_ns,
        period_s=_distribution(arrivals.period_s),
        lateness_s=_distribution(arrivals.lateness_s),
        publishers=len(arrivals.publishers),
        frames=() if extractor is None else tuple(sorted(extractor.noted_frames)),
        objects=evidence.objects,
        most_at_once=evidence.most_at_once,
        name="" if planned.layout is None else planned.layout.name,
        names=tuple(sorted(evidence.object_names)),
        classes=tuple(sorted(classes, key=lambda name: name or "")),
        class_changes=motions.change_count,
        signals=() if planned.mapping is None else tuple(signal.name for signal in planned.mapping.signals),
        size=_distribution(evidence.size),
        shorter_side=_distribution(evidence.shorter),
        low=tuple(filter(math.isfinite, evidence.low.tolist())),
        high=tuple(filter(math.isfinite, evidence.high.tolist())),
        speed=_distribution(motions.speed),
        turn_rate=_distribution(motions.turn_rate),
        bottom=_distribution(evidence.bottom),
        top=_distribution(evidence.top),
        uncertainty=_distribution(evidence.uncertainty),
    )


def _distribution(spread: Spread) -> Distribution | None:
    if not spread.count:
        return None
    return Distribution(spread.least, spread.median, spread.greatest, spread.greatest_ns or None)
