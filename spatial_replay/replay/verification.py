"""Certificates of logs: verification, first differences, and signatures.

Signatures are detached. ssh-keygen makes and checks them with existing SSH keys. The signed text is the
recorded certificate. The namespace "spatial-replay" rules out signatures for other purposes.
"""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import numpy as np

from spatial_replay.annotate.certificate import PLAN_SHA256, plan_sha256
from spatial_replay.bags.open import McapLog
from spatial_replay.bags.reader import Message
from spatial_replay.errors import LogError, MissingFileError, UsageError
from spatial_replay.logs.mcap.read import McapSource
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.read_options import KEYS
from spatial_replay.logs.remote import LogFile
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.schemas.Robustness_pb2 import Robustness
from spatial_replay.logs.schemas.Specification_pb2 import Specification as SpecificationMessage
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import (
    CERTIFICATE,
    DERIVED,
    METADATA,
    OBJECTS,
    PLAN_METADATA,
    ROBUSTNESS,
    SPECIFICATION,
)
from spatial_replay.monitor.verdict import Semantics
from spatial_replay.replay.engine import Replay, load_files, run_replay
from spatial_replay.replay.selection import CLIP_METADATA, KEEP_ALL, ReplayOptions, Window, clipped_source
from spatial_replay.spec.formula import Specification
from spatial_replay.text import Instant, Sentence, counted_from, printable
from spatial_replay.version import __version__

NAMESPACE = "spatial-replay"
LARGEST_SIGNATURE = 2**16
"""Size limit of a signature file, bytes."""
_HEADING = "spatial-replay certificate 1"
_PUBLIC_KEY = re.compile(r"(?:ssh|ecdsa|sk)-[\w@.-]+ [A-Za-z0-9+/]+=*(?: (?P<comment>.*))?$")
_LONGEST_S = 120.0
"""Timeout for a passphrase or a touch of a hardware key, seconds."""


def statement(certificate: Mapping[str, str]) -> bytes:
    """Return the signed text of a certificate: one entry per line, sorted by name."""
    return "\n".join(
        [_HEADING, *(f"{key} {value}" for key, value in sorted(certificate.items())), ""]
    ).encode()


def sign_certificate(certificate: Mapping[str, str], key: Path) -> bytes:
    """Return a signature over a certificate.

    Args:
        key: path of a private OpenSSH key. If ssh-agent or a token holds the private key, path of the public
            key.

    Raises:
        MissingFileError: there is no such key.
        UsageError: ssh-keygen is missing, or cannot sign with the key.
    """
    _require(key)
    signing = _ssh_keygen(["sign", "-f", str(key.resolve()), "-n", NAMESPACE], statement(certificate))
    if signing.returncode != 0 or not signing.stdout:
        raise UsageError(
            f"{key} cannot sign: {_reason(signing)}; give an OpenSSH key, such as ~/.ssh/id_ed25519"
        )
    return signing.stdout


def signer_of(certificate: Mapping[str, str], signature: Path, signers: Path) -> str | None:
    """Return the name of the signer of a certificate; None if no given signer signed it.

    Args:
        signers: file with one public key per line, such as id_ed25519.pub, authorized_keys, or an
            allowed_signers file of OpenSSH.

    Raises:
        MissingFileError: one of the files is missing.
        UsageError: `signers` has no public key, or ssh-keygen is missing.
    """
    for file in (signature, signers):
        _require(file)
    if signature.stat().st_size > LARGEST_SIGNATURE:
        return None
    allowed_text, signer_names = _allowed_signers(signers)
    with TemporaryDirectory(prefix="spatial-replay-") as folder:
        (signers_file := Path(folder) / "allowed_signers").write_text(allowed_text)
        file_arguments = ["-f", str(signers_file), "-s", str(signature.resolve())]
        search = _ssh_keygen(["find-principals", *file_arguments], b"")
        # ssh-keygen verifies a signature for one principal at a time
        for principal in search.stdout.decode("utf-8", "replace").splitlines():
            arguments = ["verify", *file_arguments, "-n", NAMESPACE, "-I", principal]
            if _ssh_keygen(arguments, statement(certificate)).returncode == 0:
                return signer_names.get(principal, principal)
    return None


def _allowed_signers(signers: Path) -> tuple[str, dict[str, str]]:
    """Return the text of an allowed_signers file, and a readable name for each generated principal."""
    try:
        lines = [line.strip() for line in signers.read_text().splitlines()]
    except UnicodeDecodeError:
        raise UsageError(f"{signers} is not text; give public keys or an allowed_signers file") from None
    allowed_lines, name_by_principal = [], {}
    for key_number, line in enumerate((line for line in lines if line and not line.startswith("#")), 1):
        if bare_key := _PUBLIC_KEY.match(line):
            # a line of allowed_signers begins with a principal (man ssh-keygen), which bare keys lack
            name_by_principal[f"key{key_number}"] = (
                bare_key["comment"] or f"key {key_number} of {signers.name}"
            )
            allowed_lines.append(f"key{key_number} {line}")
        else:
            allowed_lines.append(line)
    if not allowed_lines:
        raise UsageError(f"{signers} has no public key; give an id_ed25519.pub or an allowed_signers file")
    return "\n".join([*allowed_lines, ""]), name_by_principal


def _require(path: Path) -> None:
    try:
        path.open("rb").close()
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from None


def _ssh_keygen(arguments: Sequence[str], content: bytes) -> subprocess.CompletedProcess[bytes]:
    try:
        return subprocess.run(
            ["ssh-keygen", "-Y", *arguments],
            input=content,
            capture_output=True,
            check=False,
            timeout=_LONGEST_S,
        )
    except FileNotFoundError:
        raise UsageError(
            "signatures take ssh-keygen; install OpenSSH 8.1 or later (openssh-client)"
        ) from None
    except subprocess.TimeoutExpired:
        raise UsageError(f"ssh-keygen has not answered in {_LONGEST_S:.0f} s; is the key there?") from None


def _reason(process: subprocess.CompletedProcess[bytes]) -> str:
    lines = process.stderr.decode("utf-8", "replace").strip().splitlines()
    return printable(lines[-1]) if lines else f"ssh-keygen ended with {process.returncode}"


_QUANTITIES = ("value", "now", "lower", "upper")
_LONGEST_LINE = 80


class FirstDifferences:
    """Compares the messages of a log with the messages of a new evaluation, topic by topic."""

    def __init__(self, log: LogFile) -> None:
        self._reader = McapLog(log)
        self._recorded_messages: dict[str, Iterator[Message]] = {}
        self._differences: dict[str, Sentence] = {}

    def add(self, messages: Messages) -> None:
        """Compare the next messages of the evaluation."""
        for topic, row in zip(messages.topics, messages.rows(), strict=True):
            if topic not in self._differences:
                self._compare(topic, row.log_time_ns, row.payload)

    def finish(self) -> dict[str, Sentence]:
        """Check for messages that only the log has, and return the first difference of each topic."""
        for topic in (topic_of_log.name for topic_of_log in self._reader.topics()):
            is_compared = topic in self._recorded_messages or topic not in DERIVED
            if topic not in self._differences and is_compared:
                extra_message = next(self._messages(topic), None)
                if extra_message is not None:
                    extra_time = Instant(extra_message.log_time_ns, 0)
                    self._differences[topic] = Sentence("the one at ", extra_time, " is only in the log")
        return self._differences

    def _compare(self, topic: str, time_ns: int, payload: bytes) -> None:
        recorded_message = next(self._messages(topic), None)
        if recorded_message is None:
            self._differences[topic] = Sentence("the one at ", Instant(time_ns, 0), " is not in the log")
        elif recorded_message.log_time_ns != time_ns:
            computed_time, recorded_time = Instant(time_ns, 0), Instant(recorded_message.log_time_ns, 0)
            self._differences[topic] = Sentence(
                "one is at ", computed_time, " now, and was at ", recorded_time
            )
        elif recorded_message.payload != payload:
            difference = _difference(topic, payload, recorded_message.payload)
            if difference is not None:
                self._differences[topic] = Sentence("at ", Instant(time_ns, 0), f": {difference}")

    def _messages(self, topic: str) -> Iterator[Message]:
        if topic not in self._recorded_messages:
            self._recorded_messages[topic] = self._reader.iter_messages({topic})
        return self._recorded_messages[topic]


def explain_differences(
    recorded: Mapping[str, str], computed: Mapping[str, str], differences: Mapping[str, Sentence]
) -> list[Sentence]:
    """Return a sentence on each part of a certificate: whether the part differs, and where it differs first.

    Args:
        differences: clause on the first difference, by topic (see `FirstDifferences`).
    """
    message_clauses = {
        topic: clause for topic, clause in differences.items() if topic not in DERIVED and topic != OBJECTS
    }
    first_clause = next(
        (Sentence(f"on {topic}, ", clause) for topic, clause in sorted(message_clauses.items())), None
    )
    certificate_parts = (
        ("samples", differences.get(OBJECTS)),
        ("messages", first_clause or differences.get(OBJECTS)),
        ("specification", differences.get(SPECIFICATION)),
        ("results", differences.get(ROBUSTNESS)),
    )
    sentences = []
    for part_name, part_clause in certificate_parts:
        entry = f"{part_name}_sha256"
        if recorded.get(entry) == computed.get(entry):
            sentences.append(Sentence(f"{part_name:<14} the same"))
        elif part_clause is None:
            sentences.append(
                Sentence(f"{part_name:<14} differ from those certified; the log does not show where")
            )
        else:
            sentences.append(Sentence(f"{part_name:<14} differ first ", part_clause))
    if PLAN_SHA256 in recorded:
        is_same = recorded[PLAN_SHA256] == computed.get(PLAN_SHA256)
        sentences.append(
            Sentence(f"{'plan settings':<14} {'the same' if is_same else 'differ from those certified'}")
        )
    doubt_texts = [certificate.get("doubts", "none") for certificate in (recorded, computed)]
    if doubt_texts != ["none", "none"]:
        is_same = doubt_texts[0] == doubt_texts[1]
        clause = "the same" if is_same else f"{doubt_texts[1]} now, {doubt_texts[0]} recorded"
        sentences.append(Sentence(f"{'doubts':<14} {clause}"))
    recorded_version = recorded.get("spatial_replay_version", "unknown")
    is_same = recorded_version == __version__
    sentences.append(
        Sentence(
            f"{'program':<14} "
            + ("the same" if is_same else f"{__version__} now, {recorded_version} recorded")
        )
    )
    return sentences


def _difference(topic: str, new_payload: bytes, old_payload: bytes) -> str | None:
    """Return a clause on the difference of two messages; None if only their encodings differ."""
    try:
        # patterns are literals, because a bare name in a pattern would capture the topic
        match topic:
            case "/spatial/objects":
                return _of_samples(ObjectStates.FromString(new_payload), ObjectStates.FromString(old_payload))
            case "/spatial/robustness":
                return _of_results(Robustness.FromString(new_payload), Robustness.FromString(old_payload))
            case "/spatial/specification":
                return _of_specifications(
                    SpecificationMessage.FromString(new_payload),
                    SpecificationMessage.FromString(old_payload),
                )
    # the recorded payload may be any bytes
    except ValueError:
        return "what is recorded cannot be decoded"
    return f"{len(new_payload)} bytes now, {len(old_payload)} recorded, of other content"


def _of_samples(new_sample: ObjectStates, old_sample: ObjectStates) -> str | None:
    new_objects, old_objects = (
        {tracked.name: tracked for tracked in sample.objects} for sample in (new_sample, old_sample)
    )
    for name in sorted(new_objects.keys() | old_objects.keys()):
        if name not in new_objects or name not in old_objects:
            return f"`{name}` is {'only in the log' if name in old_objects else 'not in the log'}"
        for field in ("class_name", "parts", "yaw", "height", "uncertainty"):
            if getattr(new_objects[name], field) != getattr(old_objects[name], field):
                quantity = {"class_name": "class", "parts": "footprint"}.get(field, field)
                return f"`{name}` has another {quantity}"
    new_signals, old_signals = (
        {signal.name: signal.value for signal in sample.signals} for sample in (new_sample, old_sample)
    )
    for name in sorted(new_signals.keys() | old_signals.keys()):
        if new_signals.get(name) != old_signals.get(name):
            signal_values = [
                sample_signals.get(name, "missing") for sample_signals in (new_signals, old_signals)
            ]
            return f"the signal `{name}` is {signal_values[0]} now, {signal_values[1]} recorded"
    return None


def _of_results(new_result: Robustness, old_result: Robustness) -> str | None:
    if (new_result.specification, new_result.object) != (
        old_result.specification,
        old_result.object,
    ):
        return f"`{new_result.specification}` now, `{old_result.specification}` recorded"
    for new_node, old_node in zip_longest(new_result.nodes, old_result.nodes):
        if new_node is None or old_node is None:
            return (
                f"`{new_result.specification}` has {len(new_result.nodes)} nodes now, "
                f"{len(old_result.nodes)} recorded"
            )
        for quantity in _QUANTITIES:
            numbers = getattr(new_node, quantity), getattr(old_node, quantity)
            if not np.array_equal(*numbers, equal_nan=True):
                node_text = f"`{new_node.name or f'node {new_node.id}'}` in `{new_result.specification}`"
                return f"{quantity} of {node_text} is {numbers[0]!r} now, {numbers[1]!r} recorded"
    return None


def _of_specifications(new_message: SpecificationMessage, old_message: SpecificationMessage) -> str | None:
    for new_file, old_file in zip_longest(new_message.files, old_message.files):
        if new_file is None or old_file is None:
            return f"{len(new_message.files)} files now, {len(old_message.files)} recorded"
        line_pairs = zip_longest(
            new_file.canonical.splitlines(), old_file.canonical.splitlines(), fillvalue=""
        )
        for line_number, (new_line, old_line) in enumerate(line_pairs, 1):
            if new_line != old_line:
                line_texts = [printable(text, _LONGEST_LINE) for text in (new_line, old_line)]
                place = f"{new_file.name}, line {line_number} as formatted"
                return f"{place}: `{line_texts[0]}` now, `{line_texts[1]}` recorded"
    return None


_HASHES: Mapping[str, str] = MappingProxyType(
    {
        "samples_sha256": "other samples",
        "messages_sha256": "other messages",
        "specification_sha256": "another specification",
        "results_sha256": "other results",
        PLAN_SHA256: "other plan settings",
        "doubts": "other doubts",
    }
)
"""Description of a difference, by entry of a certificate."""

_NOT_COVERED = (
    "plan settings are not covered by this certificate; --decisions recomputes what followed from them"
)
_NO_PLAN = "no plan settings: the log was planned, and its decisions cannot be recomputed without"

_WINDOW = ("start_ns", "end_ns", "every")


@dataclass(frozen=True, slots=True)
class Verified:
    """A recorded certificate, and the certificate of a new evaluation.

    Attributes:
        recorded: the log's certificate; empty if it has none.
        computed: certificate of the new evaluation.
        faults: losses while reading.
        explanation: sentences of `explain_differences`; empty if not requested.
        lacks_plan: whether the log was planned, but neither the log nor its certificate has plan settings.
        notes: sentences on parts that the certificate does not cover.
    """

    recorded: Mapping[str, str]
    computed: Mapping[str, str]
    faults: tuple[str, ...] = ()
    explanation: tuple[str, ...] = ()
    lacks_plan: bool = False
    notes: tuple[str, ...] = ()

    @property
    def differences(self) -> tuple[str, ...]:
        """A sentence on each difference; empty if the certificates are equal."""
        if not self.recorded:
            return ("the log has no certificate: it is not annotated, or was not written to its end",)
        differences = [
            f"{text}: {self.computed.get(entry, 'nothing')} now, "
            f"{self.recorded.get(entry, 'nothing')} recorded"
            for entry, text in _HASHES.items()
            if self.recorded.get(entry) != self.computed.get(entry)
            # older certificates have no hash of the plan settings
            and not (entry == PLAN_SHA256 and entry not in self.recorded)
        ]
        return (*differences, *([_NO_PLAN] if self.lacks_plan else []))


def verify_certificate(
    log: Source,
    source: Source | None = None,
    advance: Callable[[int], None] = lambda samples: None,
    *,
    explain: bool = False,
) -> Verified:
    """Compare a log's certificate with a new evaluation, which uses the log's specifications and options.

    Args:
        source: source of the log, which is evaluated; None evaluates the log itself.
        advance: function that is called with the number of samples of each evaluated block.
        explain: whether the first differences are searched, which takes another evaluation.

    Raises:
        UsageError, LogError, SpecificationError: the log cannot be evaluated.
    """
    metadata = dict(log.metadata())
    recorded, log_record = metadata.get(CERTIFICATE, {}), metadata.get(METADATA, {})
    if not recorded:
        return Verified({}, {})
    options = _options(log_record)
    if source is None and options.get("layer"):
        raise UsageError(
            f"{log.name} is a layer without samples; give the log that it was made from: --source SOURCE"
        )
    kept_topics = None if source is None else _topics_of_copy(log_record, options)
    clip_record = metadata.get(CLIP_METADATA, {})
    # a replay of a clip also has the clip's record; a source that already is this clip is not cut again
    if source is not None and clip_record and dict(source.metadata()).get(CLIP_METADATA) != clip_record:
        source, kept_topics = clipped_source(source, clip_record), None
    evaluated_source = log if source is None else source
    replay_options = ReplayOptions(
        Window(**{option: options[option] for option in _WINDOW if option in options}),
        options.get("each", {}),
        _semantics(log_record),
        keep=kept_topics,
        arrow=str(options.get("arrow", "")),
    )
    replayed = run_replay(evaluated_source, _files(log), replay_options, advance=advance)
    computed = dict(replayed.certificate)
    plan_settings = metadata.get(PLAN_METADATA)
    if not options.get("layer") and recorded.get(PLAN_SHA256) == computed.get(PLAN_SHA256):
        # the source has the certified settings, so the log's own copy is checked, too
        computed |= {} if plan_settings is None else {PLAN_SHA256: plan_sha256(plan_settings)}
        if plan_settings is None:
            computed.pop(PLAN_SHA256, None)
    lacks_plan = log_record.get("planned") == "true" and plan_settings is None and PLAN_SHA256 not in recorded
    lacks_plan = lacks_plan and not options.get("layer")
    is_plan_covered = plan_settings is None or PLAN_SHA256 in recorded
    notes = () if is_plan_covered else (_NOT_COVERED,)
    verified = Verified(dict(recorded), computed, replayed.faults, lacks_plan=lacks_plan, notes=notes)
    if not explain:
        return verified
    first_differences: Mapping[str, Sentence] = {}
    if verified.differences and isinstance(log, McapSource):
        comparison = FirstDifferences(log.path)
        Replay(evaluated_source, _files(log), replay_options, certify=False).run(
            comparison.add, layer=bool(options.get("layer")), advance=advance
        )
        first_differences = comparison.finish()
    explanation = explain_differences(verified.recorded, verified.computed, first_differences)
    return replace(verified, explanation=counted_from(explanation, replayed.first_ns))


def recorded_reading(log: Source, source: str) -> dict[str, Any]:
    """Return the recorded reading options of a log's source, such as the frame rate of a video.

    Args:
        source: file name of a source. Only the recorded source has options.
    """
    log_record = dict(log.metadata()).get(METADATA, {})
    if log_record.get("source") != source:
        return {}
    try:
        options = json.loads(log_record.get("options", "{}"))
    except ValueError:
        return {}
    return {name: options[name] for name in KEYS if name in options} if isinstance(options, dict) else {}


def _files(log: Source) -> list[Specification]:
    """Return the specifications that a log was written with, if any."""
    try:
        return load_files((), log)
    except UsageError:
        return []


def _options(log_record: Mapping[str, str]) -> dict[str, Any]:
    """Return the options of the replay that wrote a log; empty for a recording."""
    if log_record.get("written_by") != "replay":
        return {}
    try:
        options = json.loads(log_record.get("options", "{}"))
    except ValueError as error:
        raise LogError(f"the options in the log's metadata cannot be read: {error}") from error
    return options if isinstance(options, dict) else {}


def _topics_of_copy(log_record: Mapping[str, str], options: Mapping[str, Any]) -> tuple[str, ...] | None:
    """Return the source's topics that a log keeps: none for a recording, by default all for a copy.

    For a layer, the result is None.
    """
    if log_record.get("written_by") != "replay":
        return ()
    return None if options.get("layer") else tuple(options.get("keep", KEEP_ALL))


def _semantics(log_record: Mapping[str, str]) -> Semantics:
    return "paper" if log_record.get("semantics") == "paper" else "ltlf"
