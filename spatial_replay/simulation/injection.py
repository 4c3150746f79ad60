"""What is given in place of what a seed decides, or goes wrong: starts of bodies, and injected failures."""

from __future__ import annotations

import math
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


@dataclass(frozen=True, slots=True)
class Start:
    """Where a body is at the beginning, in place of where the seed puts it.

    Attributes:
        x, y: its centre, in metres.
        turn: its yaw, in radians; None for that of the seed.
    """

    name: str
    x: float
    y: float
    turn: float | None = None

    @classmethod
    def parse(cls, text: str) -> Start:
        """Parse `red=0.47,-0.09` or `red=0.47,-0.09,0.4`.

        Raises:
            UsageError: anything else.
        """
        name, _, place = text.partition("=")
        try:
            numbers = [float(number) for number in place.split(",")]
        except ValueError:
            numbers = []
        if not name or not 2 <= len(numbers) <= 3 or not all(map(math.isfinite, numbers)):
            raise UsageError(
                f"{text!r} is no start; write NAME=X,Y in metres, or NAME=X,Y,TURN with radians, such as "
                "red=0.47,-0.09,0.4"
            )
        return cls(name.strip(), *numbers)

    def __str__(self) -> str:
        numbers = [self.x, self.y] + ([] if self.turn is None else [self.turn])
        return f"{self.name}={','.join(f'{number:.12g}' for number in numbers)}"
