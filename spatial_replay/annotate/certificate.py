"""Certificates: hashes of the inputs and the results of an evaluation.

Hashes depend only on content, not on the cut into blocks, chunks or files. So copies of
a recording in two containers have the same sample hash.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.logs.messages import Messages
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.spec.format import format_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.trace import ABSENT, Trace
from spatial_replay.version import __version__


class SampleHash:
    """SHA-256 of samples: all columns of objects and signals, sorted by name."""

    def __init__(self) -> None:
        self._times = hashlib.sha256()
        self._objects: dict[str, list[hashlib._Hash]] = {}
        self._signals: dict[str, hashlib._Hash] = {}
        self._reports: dict[str, hashlib._Hash] = {}
        self._lasting: set[str] = set()

    def add(self, trace: Trace) -> None:
        """Add the next samples."""
        _update(self._times, _integers(trace.times_ns))
        class_digests = np.array(
            [list(hashlib.sha256(_text(name)).digest()) for name in trace.classes], np.uint8
        )
        for name, footprint_rows in zip(trace.names, trace.rows.T, strict=True):
            seen_samples = np.flatnonzero(footprint_rows != ABSENT)
            if not len(seen_samples):
                continue
            # unreadable observations are stored under the row number -2 - row
            observations = np.where(footprint_rows < ABSENT, -2 - footprint_rows, footprint_rows)[
                seen_samples
            ]
            footprints = trace.footprints.select(observations)
            columns = (
                _integers(trace.times_ns[seen_samples]),
                _integers(np.diff(footprints.part_start)),
                _integers(np.diff(footprints.vertex_start)),
                _floats(footprints.vertices),
                _floats(footprints.radius),
                _floats(footprints.bottom),
                _floats(footprints.top),
                _floats(trace.yaw[observations]),
                _floats(trace.uncertainty[observations]),
                class_digests[trace.class_code[observations]],
            )
            if name in trace.lasting and (footprint_rows >= 0).any():
                self._lasting.add(name)
            if trace.reported_ns is not None:
                self._add_reports(
                    name, trace.times_ns, trace.reported_ns[:, trace.names.index(name)], footprint_rows >= 0
                )
            hashes = self._objects.setdefault(name, [hashlib.sha256() for _ in columns])
            for hasher, column in zip(hashes, columns, strict=True):
                _update(hasher, column)
        for name, signal_values in trace.signals.items():
            known_samples = np.flatnonzero(~np.isnan(signal_values))
            if len(known_samples):
                hasher = self._signals.setdefault(name, hashlib.sha256())
                time_value_pairs = np.rec.fromarrays(
                    [trace.times_ns[known_samples], signal_values[known_samples]]
                )
                _update(hasher, time_value_pairs.tobytes())
        for name, reported_ns in trace.signals_reported_ns.items():
            is_known = ~np.isnan(trace.signals[name])
            self._add_reports(f"signal {name}", trace.times_ns, reported_ns, is_known)

    def _add_reports(
        self, report_name: str, times_ns: Integers, reported_ns: Integers, is_known: Booleans
    ) -> None:
        """Add the report times that differ from the time of their sample; many logs have no such times."""
        earlier_samples = np.flatnonzero(is_known & (reported_ns != times_ns))
        if len(earlier_samples):
            hasher = self._reports.setdefault(report_name, hashlib.sha256())
            _update(
                hasher,
                np.column_stack([times_ns[earlier_samples], reported_ns[earlier_samples]])
                .astype("<i8")
                .tobytes(),
            )

    def hexdigest(self) -> str:
        total_hash = hashlib.sha256(self._times.digest())
        for name in sorted(self._objects):
            total_hash.update(_text(name))
            for hasher in self._objects[name]:
                total_hash.update(hasher.digest())
        for name in sorted(self._signals):
            total_hash.update(_text(name) + self._signals[name].digest())
        for report_name in sorted(self._reports):
            total_hash.update(_text(report_name) + self._reports[report_name].digest())
        for name in sorted(self._lasting):
            total_hash.update(_text(f"lasting {name}"))
        return total_hash.hexdigest()


class MessageHash:
    """SHA-256 of messages: the times and bytes of each topic's messages, in order.

    The order between topics does not change the hash. Several threads send messages to a
    recorder, which may write later messages of one topic before earlier messages of another topic.
    """

    def __init__(self) -> None:
        # one hash per column, so that many messages are hashed at once, for any cut into blocks
        self._topics: dict[str, tuple[hashlib._Hash, hashlib._Hash, hashlib._Hash]] = {}

    def add(self, messages: Messages) -> None:
        """Add the next messages."""
        for topic, message_indices in messages.by_topic():
            payloads = [messages.payloads[message_index] for message_index in message_indices.tolist()]
            lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
            hashes = self._topics.setdefault(topic, (hashlib.sha256(), hashlib.sha256(), hashlib.sha256()))
            _update(hashes[0], _integers(messages.log_time_ns[message_indices]))
            _update(hashes[1], _integers(lengths))
            _update(hashes[2], b"".join(payloads))

    def hexdigest(self) -> str:
        total_hash = hashlib.sha256()
        for topic in sorted(self._topics):
            total_hash.update(_text(topic))
            for hasher in self._topics[topic]:
                total_hash.update(hasher.digest())
        return total_hash.hexdigest()


PLAN_SHA256 = "plan_sha256"
"""Name of a certificate's entry with the hash of a planned run's settings."""


def plan_sha256(plan: Mapping[str, str]) -> str:
    """Return the SHA-256 of the metadata of a planned run: names and values, sorted by name."""
    digest = hashlib.sha256()
    for name, value in sorted(plan.items()):
        digest.update(_text(name) + _text(value))
    return digest.hexdigest()


def specifications_json(files: Sequence[Specification]) -> str:
    """Return specifications as JSON for metadata: a list of name, SHA-256 of the text, and plug-ins."""
    entries = []
    for file in files:
        text = format_specification(file).encode("utf-8", "surrogatepass")
        plugins = {"plugins": file.plugins} if file.plugins else {}
        entries.append({"name": file.filename, "sha256": hashlib.sha256(text).hexdigest(), **plugins})
    return json.dumps(entries)


class EvaluationHashes:
    """The hashes of an evaluation: hashes of the samples, the log's other messages, and the results."""

    def __init__(self, names: Sequence[tuple[str, str | None]]) -> None:
        """Start before the first sample.

        Args:
            names: name of each result, and the object of the result's instance; None without a template.
        """
        self._samples, self._messages = SampleHash(), MessageHash()
        self._results = [(_text(name) + _text(object), hashlib.sha256()) for name, object in names]

    def add_samples(self, trace: Trace, own: Messages) -> None:
        """Add the next samples and the log's own messages. Results of the samples may be in other blocks."""
        self._samples.add(trace)
        self._messages.add(own)

    def add_results(self, results: Sequence[SeriesBlock]) -> None:
        """Add the next numbers of each result, sample by sample, node by node."""
        for (_, hasher), block in zip(self._results, results, strict=True):
            _update(hasher, _floats(block.series.transpose(2, 0, 1)))

    def certificate(
        self,
        files: Sequence[Specification],
        plan: Mapping[str, str] | None = None,
        doubts: Iterable[str] = (),
    ) -> Mapping[str, str]:
        """Return the certificate of the finished evaluation.

        Args:
            plan: metadata of a planned run; None without a plan.
            doubts: titles of the doubts about the log.
        """
        doubt_titles = ", ".join(sorted(doubts))
        specifications_hash, results_hash = hashlib.sha256(), hashlib.sha256()
        for file in files:
            specifications_hash.update(_text(format_specification(file)))
        for encoded_name, hasher in self._results:
            results_hash.update(encoded_name + hasher.digest())
        return {
            "samples_sha256": self._samples.hexdigest(),
            "messages_sha256": self._messages.hexdigest(),
            "specification_sha256": specifications_hash.hexdigest(),
            "results_sha256": results_hash.hexdigest(),
            **({} if plan is None else {PLAN_SHA256: plan_sha256(plan)}),
            **({"doubts": doubt_titles} if doubt_titles else {}),
            "spatial_replay_version": __version__,
        }


def _update(hasher: hashlib._Hash, buffer: bytes | memoryview | NDArray[np.generic]) -> None:
    # hashlib accepts an array as a buffer, but its type stub does not
    hasher.update(cast(bytes, buffer))


def _integers(values: Integers) -> NDArray[np.generic]:
    """Return contiguous little-endian int64, copied only if necessary."""
    return np.ascontiguousarray(values, "<i8")


def _floats(values: Floats) -> NDArray[np.generic]:
    """Return contiguous little-endian float64, with equal bits for all NaN."""
    little_endian = np.ascontiguousarray(values, "<f8")
    is_nan = np.isnan(little_endian)
    return np.where(is_nan, np.nan, little_endian) if is_nan.any() else little_endian


def _text(text: str | None) -> bytes:
    """Encode a text with its length, so that no two sequences of texts have the same bytes."""
    if text is None:
        return b"\xff" * 8
    encoded = text.encode("utf-8", "surrogatepass")
    return len(encoded).to_bytes(8, "little") + encoded
