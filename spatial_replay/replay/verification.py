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
    """Return the signed text of a certificate: one entry per line, in the order of names."""
    return "\n".join(
        [_HEADING, *(f"{key} {value}" for key, value in sorted(certificate.items())), ""]
    ).encode()


def sign_certificate(certificate: Mapping[str, str], key: Path) -> bytes:
    """Return a signature over a certificate.

    Args:
        key: a private key of OpenSSH, or the public one of a key that ssh-agent or a token holds.

    Raises:
        MissingFileError: there is no such key.
        UsageError: ssh-keygen is missing, or cannot sign with it.
    """
    _require(key)
    signed = _ssh_keygen(["sign", "-f", str(key.resolve()), "-n", NAMESPACE], statement(certificate))
    if signed.returncode != 0 or not signed.stdout:
        raise UsageError(
            f"{key} cannot sign: {_reason(signed)}; give an OpenSSH key, such as ~/.ssh/id_ed25519"
        )
    return signed.stdout


def signer_of(certificate: Mapping[str, str], signature: Path, signers: Path) -> str | None:
    """Return the signer of a certificate among given signers; None if none of them signed it.

    Args:
        signers: public keys, one a line, as in id_ed25519.pub or authorized_keys, or an allowed_signers file
            of OpenSSH, with names before the keys.

    Raises:
        MissingFileError: one of the files is missing.
        UsageError: the file has no signers, or ssh-keygen is missing.
    """
    for file in (signature, signers):
        _require(file)
    if signature.stat().st_size > LARGEST_SIGNATURE:
        return None
    allowed, names = _allowed_signers(signers)
    with TemporaryDirectory(prefix="spatial-replay-") as folder:
        (signers_file := Path(folder) / "allowed_signers").write_text(allowed)
        files = ["-f", str(signers_file), "-s", str(signature.resolve())]
        principals = _ssh_keygen(["find-principals", *files], b"")
        # ssh-keygen verifies a signature for one principal at a time
        for principal in principals.stdout.decode("utf-8", "replace").splitlines():
            arguments = ["verify", *files, "-n", NAMESPACE, "-I", principal]
            if _ssh_keygen(arguments, statement(certificate)).returncode == 0:
                return names.get(principal, principal)
    return None


def _allowed_signers(signers: Path) -> tuple[str, dict[str, str]]:
    """Return the text of an allowed_signers file, and names for its principals of bare keys."""
    try:
        lines = [line.strip() for line in signers.read_text().splitlines()]
    except UnicodeDecodeError:
        raise UsageError(f"{signers} is not text; give public keys or an allowed_signers file") from None
    allowed_lines, names = [], {}
    for number, line in enumerate((line for line in lines if line and not line.startswith("#")), 1):
        if bare := _PUBLIC_KEY.match(line):
            # a line of allowed_signers begins with a principal (man ssh-keygen), which bare keys lack
            names[f"key{number}"] = bare["comment"] or f"key {number} of {signers.name}"
            allowed_lines.append(f"key{number} {line}")
        else:
            allowed_lines.append(line)
    if not allowed_lines:
        raise UsageError(f"{signers} has no public key; give an id_ed25519.pub or an allowed_signers file")
    return "\n".join([*allowed_lines, ""]), names


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


def _reason(ended: subprocess.CompletedProcess[bytes]) -> str:
    lines = ended.stderr.decode("utf-8", "replace").strip().splitlines()
    return printable(lines[-1]) if lines else f"ssh-keygen ended with {ended.returncode}"


_QUANTITIES = ("value", "now", "lower", "upper")
_LONGEST_LINE = 80


class FirstDifferences:
    """Compares the messages of a log with those of a new evaluation, topic by topic."""

    def __init__(self, log: LogFile) -> None:
        self._reader = McapLog(log)
        self._recorded: dict[str, Iterator[Message]] = {}
        self._found: dict[str, Sentence] = {}

    def add(self, messages: Messages) -> None:
        """Compare the next messages of the evaluation."""
        for topic, row in zip(messages.topics, messages.rows(), strict=True):
            if topic not in self._found:
                self._compare(topic, row.log_time_ns, row.payload)

    def finish(self) -> dict[str, Sentence]:
        """Check for messages that only the log has, and return the first difference of each topic."""
        for topic in (topic_of_log.name for topic_of_log in self._reader.topics()):
            is_compared = topic in self._recorded or topic not in DERIVED
            if topic not in self._found and is_compared:
                extra = next(self._messages(topic), None)
                if extra is not None:
                    when = Instant(extra.log_time_ns, 0)
                    self._found[topic] = Sentence("the one at ", when, " is only in the log")
        return self._found

    def _compare(self, topic: str, time_ns: int, payload: bytes) -> None:
        recorded = next(self._messages(topic), None)
        if recorded is None:
            self._found[topic] = Sentence("the one at ", Instant(time_ns, 0), " is not in the log")
        elif recorded.log_time_ns != time_ns:
            now, then = Instant(time_ns, 0), Instant(recorded.log_time_ns, 0)
            self._found[topic] = Sentence("one is at ", now, " now, and was at ", then)
        elif recorded.payload != payload:
            what = _difference(topic, payload, recorded.payload)
            if what is not None:
                self._found[topic] = Sentence("at ", Instant(time_ns, 0), f": {what}")

    def _messages(self, topic: str) -> Iterator[Message]:
        if topic not in self._recorded:
            self._recorded[topic] = self._reader.iter_messages({topic})
        return self._recorded[topic]


def explain_differences(
    recorded: Mapping[str, str], computed: Mapping[str, str], differences: Mapping[str, Sentence]
) -> list[Sentence]:
    """Return a sentence on each part of a certificate: equal, or where it differs first.

    Args:
        differences: the first difference of each topic, in a clause; see `FirstDifferences`.
    """
    beside = {topic: what for topic, what in differences.items() if topic not in DERIVED and topic != OBJECTS}
    first = next((Sentence(f"on {topic}, ", what) for topic, what in sorted(beside.items())), None)
    parts = (
        ("samples", differences.get(OBJECTS)),
        ("messages", first or differences.get(OBJECTS)),
        ("specification", differences.get(SPECIFICATION)),
        ("results", differences.get(ROBUSTNESS)),
    )
    lines = []
    for name, where in parts:
        key = f"{name}_sha256"
        if recorded.get(key) == computed.get(key):
            lines.append(Sentence(f"{name:<14} the same"))
        elif where is None:
            lines.append(Sentence(f"{name:<14} differ from those certified; the log does not show where"))
        else:
            lines.append(Sentence(f"{name:<14} differ first ", where))
    if PLAN_SHA256 in recorded:
        is_same = recorded[PLAN_SHA256] == computed.get(PLAN_SHA256)
        lines.append(
            Sentence(f"{'plan settings':<14} {'the same' if is_same else 'differ from those certified'}")
        )
    doubts = [certificate.get("doubts", "none") for certificate in (recorded, computed)]
    if doubts != ["none", "none"]:
        is_same = doubts[0] == doubts[1]
        what = "the same" if is_same else f"{doubts[1]} now, {doubts[0]} recorded"
        lines.append(Sentence(f"{'doubts':<14} {what}"))
    version = recorded.get("spatial_replay_version", "unknown")
    is_same = version == __version__
    lines.append(
        Sentence(f"{'program':<14} " + ("the same" if is_same else f"{__version__} now, {version} recorded"))
    )
    return lines


def _difference(topic: str, now: bytes, then: bytes) -> str | None:
    """Return the difference of a message from the recorded one; None if only the encoding differs."""
    try:
        # literals, because a bare name in a pattern would capture the topic
        match topic:
            case "/spatial/objects":
                return _of_samples(ObjectStates.FromString(now), ObjectStates.FromString(then))
            case "/spatial/robustness":
                return _of_results(Robustness.FromString(now), Robustness.FromString(then))
            case "/spatial/specification":
                return _of_specifications(
                    SpecificationMessage.FromString(now), SpecificationMessage.FromString(then)
                )
    # the recorded payload may be any bytes
    except ValueError:
        return "what is recorded cannot be decoded"
    return f"{len(now)} bytes now, {len(then)} recorded, of other content"


def _of_samples(now: ObjectStates, then: ObjectStates) -> str | None:
    objects, before = ({tracked.name: tracked for tracked in sample.objects} for sample in (now, then))
    for name in sorted(objects.keys() | before.keys()):
        if name not in objects or name not in before:
            return f"`{name}` is {'only in the log' if name in before else 'not in the log'}"
        for field in ("class_name", "parts", "yaw", "height", "uncertainty"):
            if getattr(objects[name], field) != getattr(before[name], field):
                what = {"class_name": "class", "parts": "footprint"}.get(field, field)
                return f"`{name}` has another {what}"
    signals, old = ({signal.name: signal.value for signal in sample.signals} for sample in (now, then))
    for name in sorted(signals.keys() | old.keys()):
        if signals.get(name) != old.get(name):
            values = [side.get(name, "missing") for side in (signals, old)]
            return f"the signal `{name}` is {values[0]} now, {values[1]} recorded"
    return None


def _of_results(now: Robustness, then: Robustness) -> str | None:
    if (now.specification, now.object) != (then.specification, then.object):
        return f"`{now.specification}` now, `{then.specification}` recorded"
    for node_now, node_then in zip_longest(now.nodes, then.nodes):
        if node_now is None or node_then is None:
            return f"`{now.specification}` has {len(now.nodes)} nodes now, {len(then.nodes)} recorded"
        for name in _QUANTITIES:
            values = getattr(node_now, name), getattr(node_then, name)
            if not np.array_equal(*values, equal_nan=True):
                node = f"`{node_now.name or f'node {node_now.id}'}` in `{now.specification}`"
                return f"{name} of {node} is {values[0]!r} now, {values[1]!r} recorded"
    return None


def _of_specifications(now: SpecificationMessage, then: SpecificationMessage) -> str | None:
    for file_now, file_then in zip_longest(now.files, then.files):
        if file_now is None or file_then is None:
            return f"{len(now.files)} files now, {len(then.files)} recorded"
        lines = zip_longest(file_now.canonical.splitlines(), file_then.canonical.splitlines(), fillvalue="")
        for number, (line, before) in enumerate(lines, 1):
            if line != before:
                texts = [printable(text, _LONGEST_LINE) for text in (line, before)]
                place = f"{file_now.name}, line {number} as formatted"
                return f"{place}: `{texts[0]}` now, `{texts[1]}` recorded"
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
"""The meaning of a difference, by entry of a certificate."""

_NOT_COVERED = (
    "plan settings are not covered by this certificate; --decisions recomputes what followed from them"
)
_NO_PLAN = "no plan settings: the log was planned, and its decisions cannot be recomputed without"

_WINDOW = ("start_ns", "end_ns", "every")


@dataclass(frozen=True, slots=True)
class Verified:
    """A certificate as recorded, and as computed now.

    Attributes:
        recorded: the log's certificate; empty if it has none.
        computed: certificate of the new evaluation.
        faults: losses while reading.
        explanation: result of `explain_differences`; empty unless requested.
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
        """The differences in words; none if everything is equal."""
        if not self.recorded:
            return ("the log has no certificate: it is not annotated, or was not written to its end",)
        differences = [
            f"{what}: {self.computed.get(key, 'nothing')} now, {self.recorded.get(key, 'nothing')} recorded"
            for key, what in _HASHES.items()
            if self.recorded.get(key) != self.computed.get(key)
            # older certificates have no hash of the plan settings
            and not (key == PLAN_SHA256 and key not in self.recorded)
        ]
        return (*differences, *([_NO_PLAN] if self.lacks_plan else []))


def verify_certificate(
    log: Source,
    source: Source | None = None,
    advance: Callable[[int], None] = lambda samples: None,
    *,
    explain: bool = False,
) -> Verified:
    """Evaluate a log, or its source, again with the log's own specifications and options.

    Args:
        source: the source of the log; None evaluates the log itself.
        advance: called with the number of samples of each block that is done.
        explain: find the first differences, which takes another evaluation.

    Raises:
        UsageError, LogError, SpecificationError: the log cannot be evaluated.
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
    keep = None if source is None else _topics_of_copy(about, options)
    clip = metadata.get(CLIP_METADATA, {})
    # a replay of a clip also has the clip's record; if the source is that clip, it is not cut again
    if source is not None and clip and dict(source.metadata()).get(CLIP_METADATA) != clip:
        source, keep = clipped_source(source, clip), None
    evaluated = log if source is None else source
    replay_options = ReplayOptions(
        Window(**{name: options[name] for name in _WINDOW if name in options}),
        options.get("each", {}),
        _semantics(about),
        keep=keep,
        arrow=str(options.get("arrow", "")),
    )
    replayed = run_replay(evaluated, _files(log), replay_options, advance=advance)
    computed = dict(replayed.certificate)
    plan = metadata.get(PLAN_METADATA)
    if not options.get("layer") and recorded.get(PLAN_SHA256) == computed.get(PLAN_SHA256):
        # the source has the certified settings, and the log's own copy of them is checked, too
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
    first_differences: Mapping[str, Sentence] = {}
    if verified.differences and isinstance(log, McapSource):
        compared = FirstDifferences(log.path)
        Replay(evaluated, _files(log), replay_options, certify=False).run(
            compared.add, layer=bool(options.get("layer")), advance=advance
        )
        first_differences = compared.finish()
    explanation = explain_differences(verified.recorded, verified.computed, first_differences)
    return replace(verified, explanation=counted_from(explanation, replayed.first_ns))


def recorded_reading(log: Source, source: str) -> dict[str, Any]:
    """Return the options with which a log's source was read, such as the rate of its frames.

    Args:
        source: file name of the given source; options apply only to the recorded source.
    """
    about = dict(log.metadata()).get(METADATA, {})
    if about.get("source") != source:
        return {}
    try:
        options = json.loads(about.get("options", "{}"))
    except ValueError:
        return {}
    return {name: options[name] for name in KEYS if name in options} if isinstance(options, dict) else {}


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


def _topics_of_copy(about: Mapping[str, str], options: Mapping[str, Any]) -> tuple[str, ...] | None:
    """Return the topics of its source that a log kept: none in a recording, by default all in a copy."""
    if about.get("written_by") != "replay":
        return ()
    return None if options.get("layer") else tuple(options.get("keep", KEEP_ALL))


def _semantics(about: Mapping[str, str]) -> Semantics:
    return "paper" if about.get("semantics") == "paper" else "ltlf"
