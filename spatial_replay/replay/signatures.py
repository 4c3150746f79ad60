"""Detached signatures over certificates, made and checked by ssh-keygen with keys that people have.

What is signed is the recorded certificate as text, in the namespace "spatial-replay", so that no signature
for another purpose fits.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from spatial_replay.errors import MissingFileError, UsageError
from spatial_replay.text import printable

NAMESPACE = "spatial-replay"
LARGEST_SIGNATURE = 2**16
_HEADING = "spatial-replay certificate 1"
_PUBLIC_KEY = re.compile(r"(?:ssh|ecdsa|sk)-[\w@.-]+ [A-Za-z0-9+/]+=*(?: (?P<comment>.*))?$")
_LONGEST_S = 120.0
"""How long a passphrase or a touch of a hardware key is waited for."""


def statement(certificate: Mapping[str, str]) -> bytes:
    """Return the text that is signed: a certificate, one entry a line, in the order of names."""
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
    """Return who of some signers signed a certificate; None if none of them did.

    Args:
        signers: public keys, one a line, as in id_ed25519.pub or authorized_keys, or an allowed_signers file
            of OpenSSH, with names before the keys.

    Raises:
        MissingFileError: one of the files is missing.
        UsageError: the signers are none, or ssh-keygen is missing.
    """
    for each in (signature, signers):
        _require(each)
    if signature.stat().st_size > LARGEST_SIGNATURE:
        return None
    allowed, names = _allowed(signers)
    with TemporaryDirectory(prefix="spatial-replay-") as folder:
        (listed := Path(folder) / "allowed_signers").write_text(allowed)
        files = ["-f", str(listed), "-s", str(signature.resolve())]
        found = _ssh_keygen(["find-principals", *files], b"")
        for principal in found.stdout.decode("utf-8", "replace").splitlines():
            arguments = ["verify", *files, "-n", NAMESPACE, "-I", principal]
            if _ssh_keygen(arguments, statement(certificate)).returncode == 0:
                return names.get(principal, principal)
    return None


def _allowed(signers: Path) -> tuple[str, dict[str, str]]:
    """Return an allowed_signers file, and names for the principals that bare keys get in it."""
    try:
        lines = [line.strip() for line in signers.read_text().splitlines()]
    except UnicodeDecodeError:
        raise UsageError(f"{signers} is not text; give public keys or an allowed_signers file") from None
    listed, names = [], {}
    for number, line in enumerate((line for line in lines if line and not line.startswith("#")), 1):
        if bare := _PUBLIC_KEY.match(line):
            names[f"key{number}"] = bare["comment"] or f"key {number} of {signers.name}"
            listed.append(f"key{number} {line}")
        else:
            listed.append(line)
    if not listed:
        raise UsageError(f"{signers} has no public key; give an id_ed25519.pub or an allowed_signers file")
    return "\n".join([*listed, ""]), names


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
