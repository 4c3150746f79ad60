"""Injected failures: what goes wrong in a run, and when."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, get_args

from spatial_replay.errors import UsageError

Kind = Literal["drop", "slip"]

DURATION_NS = {"drop": 400 * 10**6, "slip": 4 * 10**9}
"""How long an injection with a start lasts."""

_WRITTEN = re.compile(r"(?P<kind>\w+)(?:@(?P<number>\d+(?:\.\d+)?)(?P<unit>ms|s))?")


@dataclass(frozen=True, slots=True)
class Injection:
    """A failure of the gripper.

    Attributes:
        kind: `drop`: the gripper opens; `slip`: the fingers are slippery, as if oiled.
        at_ns: when it begins; None for the whole run.
    """

    kind: Kind
    at_ns: int | None = None

    @classmethod
    def parse(cls, text: str) -> Injection:
        """Parse `drop@7s`, `slip@2500ms`, or `slip` for the whole run.

        Raises:
            UsageError: anything else.
        """
        match = _WRITTEN.fullmatch(text)
        kinds: tuple[Kind, ...] = get_args(Kind)
        for kind in kinds:
            if match is None or match["kind"] != kind:
                continue
            if match["number"] is not None:
                return cls(kind, round(float(match["number"]) * (10**9 if match["unit"] == "s" else 10**6)))
            if kind == "slip":
                return cls(kind)
        raise UsageError(f"{text!r} cannot be injected; write drop@7s, slip@7s or slip")

    def holds(self, time_ns: int) -> bool:
        """Return whether the failure is active at a time."""
        return self.at_ns is None or self.at_ns <= time_ns < self.at_ns + DURATION_NS[self.kind]

    def __str__(self) -> str:
        return self.kind if self.at_ns is None else f"{self.kind}@{self.at_ns / 10**9:g}s"
