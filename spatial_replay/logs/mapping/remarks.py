"""What is not as one would wish, counted, without a loss."""

from __future__ import annotations

from collections.abc import Iterable

from spatial_replay.logs.mapping.model import Mapping

_MOST_NAMES = 8


class Remarks:
    """Counts of what became unknown, and why."""

    def __init__(self, name: str, mapping: Mapping) -> None:
        self._name = name
        self._mapping = mapping
        self._texts: list[str] = []
        self._missing: dict[tuple[str, str, bool], tuple[int, int]] = {}
        self._stale: dict[tuple[str, str], tuple[int, int]] = {}
        self._skipped: dict[str, int] = {}
        self._frames: set[str] = set()

    def add(self, text: str) -> None:
        self._texts.append(text)

    def count_missing(self, topic: str, frame: str, count: int, first_ns: int, *, is_known: bool) -> None:
        """Objects whose transform into the fixed frame is missing."""
        before, first = self._missing.get((topic, frame, is_known), (0, first_ns))
        self._missing[topic, frame, is_known] = before + count, first

    def count_stale(self, topic: str, name: str, count: int, first_ns: int) -> None:
        """Samples in which an object is unknown because its topic fell silent."""
        before, first = self._stale.get((topic, name), (0, first_ns))
        self._stale[topic, name] = before + count, first

    def count_skipped(self, topic: str, count: int) -> None:
        """Drawn things that are no bodies."""
        self._skipped[topic] = self._skipped.get(topic, 0) + count

    def note_frames(self, frames: Iterable[str]) -> None:
        """Frames that coordinates are taken in as they are."""
        if len(self._frames) < _MOST_NAMES:
            self._frames.update(frame.removeprefix("/") for frame in frames if frame)

    def take(self) -> tuple[str, ...]:
        """Every remark, once."""
        texts = [f"{self._name}: {text}" for text in self._texts]
        fixed = self._mapping.fixed_frame
        for (topic, frame, is_known), (count, first_ns) in sorted(self._missing.items()):
            reason = f"no transform from {frame!r} to {fixed!r} at that time"
            if not frame:
                reason = "its messages name no frame; give one with `frame`"
            elif not is_known:
                reason = f"no transform to {fixed!r} names the frame {frame!r}"
            texts.append(
                f"{self._name}: {topic}: {count} observation{'s are' if count != 1 else ' is'} unknown,"
                f" the first at {first_ns} ns: {reason}"
            )
        texts += self._stale_texts()
        texts += [
            f"{self._name}: {topic}: "
            + (
                f"{count} things were left out that are no bodies"
                if count != 1
                else "1 thing was left out that is no body"
            )
            + ", such as lines and texts"
            for topic, count in sorted(self._skipped.items())
        ]
        if fixed is None and len(self._frames) > 1:
            listed = ", ".join(sorted(map(repr, self._frames)))
            texts.append(
                f"{self._name}: coordinates are in the frames {listed} and taken as they are;"
                " `fixed_frame` in the mapping brings them into one"
            )
        self._texts, self._missing, self._stale, self._skipped, self._frames = [], {}, {}, {}, set()
        return tuple(texts)

    def _stale_texts(self) -> list[str]:
        by_topic: dict[str, list[tuple[str, int, int]]] = {}
        for (topic, name), (count, first_ns) in sorted(self._stale.items()):
            by_topic.setdefault(topic, []).append((name, count, first_ns))
        texts: list[str] = []
        for topic, stale in by_topic.items():
            names = ", ".join(name for name, _, _ in stale[:_MOST_NAMES])
            more = f" and {len(stale) - _MOST_NAMES} more" if len(stale) > _MOST_NAMES else ""
            most = max(count for _, count, _ in stale)
            first_ns = min(first for _, _, first in stale)
            texts.append(
                f"{self._name}: {topic}: {names}{more} are unknown in up to {most} samples, the first at"
                f" {first_ns} ns: the topic was silent for longer than max_age"
            )
        return texts
