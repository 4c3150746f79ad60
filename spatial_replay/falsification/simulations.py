"""Simulations to search: those of a scenario or of a user, with the parameters that vary in each case."""

from __future__ import annotations

import json
import math
import pickle
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple, TypeAlias, get_args

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.footprint import Footprint
from spatial_replay.logs.output_file import replacing
from spatial_replay.recording.log import refuse_templates
from spatial_replay.runs.planned import record_plan
from spatial_replay.runs.scripted import about_run, refuse_unknown_names, run_log, simulate_script
from spatial_replay.simulation.arm import least_distance
from spatial_replay.simulation.tabletop import Placement, default_specification, make_world, scenario_of
from spatial_replay.simulation.world import Box, Conditions, Injection, Kind, Start, rectangle
from spatial_replay.sources.open_log import read_trace
from spatial_replay.spec.formula import Specification
from spatial_replay.text import nearest_hint
from spatial_replay.trace.trace import Sample, Trace, duration_ns_from_text

# ------------------------------------------------------------------------------------------------- parameters

Case: TypeAlias = Mapping[str, float | None]
"""The value of each parameter by name; None where it is left out."""

Range: TypeAlias = tuple[float, float]

TENTHS: Final = 10
"""Parts of a range in which runs are counted."""
_DIGITS: Final = 6
"""Digits by which values of a range without a resolution of its own differ."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that is varied.

    Attributes:
        low, high: its range; `high` is infinite until the first run has ended, of times in a run.
        digits: decimals to which values are rounded, so that a written value is read back exactly.
        rest: its value in the unvaried run; None if that run lacks it.
        group: a search sets all parameters of a group back to rest together.
        unit: "m", "rad", "s", or "".
        is_drawn: whether its values have no order, as seeds: they are drawn, not optimised.
    """

    name: str
    low: float
    high: float
    digits: int
    rest: float | None
    group: str
    unit: str = ""
    is_drawn: bool = False

    @classmethod
    def of_range(cls, name: str, low: float, high: float) -> Parameter:
        """Return the parameter of a simulation of one's own; at rest it is as near to 0 as its range allows.

        Raises:
            UsageError: the range is empty or not finite.
        """
        low, high = float(low), float(high)
        refuse_range(name, low, high)
        digits = max(0, _DIGITS - math.floor(math.log10(high - low)))
        return cls(name, low, high, digits, min(max(low, 0.0), high), name)

    def value_at(self, share: float) -> float:
        """Return the value at a share of the range, from 0 to 1."""
        value = round(self.low + share * (self.high - self.low), self.digits)
        # rounding may leave the range
        return min(max(value, self.low), self.high) + 0.0

    def tenth_of(self, value: float) -> int:
        """Return the tenth of the range that a value is in, from 0."""
        return min(TENTHS - 1, int(TENTHS * (value - self.low) / (self.high - self.low)))

    def text_of(self, value: float) -> str:
        """Return a value with its name and unit, with all digits that it has: fewer would be another case."""
        number = f"{value:.12g}"
        if self.unit == "s":
            return f"{self.name}@{number}s"
        return f"{self.name} {number} {self.unit}".rstrip()


def refuse_range(name: str, low: float, high: float) -> None:
    """Check a range.

    Raises:
        UsageError: it is empty or not finite.
    """
    for end in (low, high):
        if not math.isfinite(end):
            raise UsageError(f"--vary {name}: {end:g} is no end of a range; write a finite number")
    if low >= high:
        raise UsageError(f"--vary {name}: {low:g} to {high:g} is no range; write the lower end first")


@dataclass(frozen=True, slots=True)
class Space:
    """All that is varied."""

    parameters: tuple[Parameter, ...]

    @property
    def ordered(self) -> tuple[Parameter, ...]:
        """The parameters that an optimiser can descend along."""
        return tuple(parameter for parameter in self.parameters if not parameter.is_drawn)

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups: mishaps first, then numbers, then starts; not seeds, of which none is smaller."""
        places = sorted(self.ordered, key=lambda parameter: (parameter.unit != "s", parameter.rest is None))
        return tuple(dict.fromkeys(parameter.group for parameter in places))

    def at_rest(self, case: Case | None = None, group: str | None = None) -> dict[str, float | None]:
        """Return a case with one group at rest, or all of it."""
        return {
            parameter.name: parameter.rest
            if case is None or parameter.group == group
            else case[parameter.name]
            for parameter in self.parameters
        }

    def nearer(self, case: Case, group: str) -> dict[str, float | None] | None:
        """Return a case with a group half way to rest; None for one that is left out there, or is there."""
        values = dict(case)
        for parameter in self.parameters:
            value = case[parameter.name]
            if parameter.group == group:
                if parameter.rest is None or value is None:
                    return None
                values[parameter.name] = round((value + parameter.rest) / 2, parameter.digits)
        return None if values == dict(case) else values

    def case_at(self, shares: Iterable[float], drawn: Sequence[float]) -> dict[str, float | None]:
        """Return the case at shares of the ordered parameters' ranges, with values for the others."""
        coming, others = iter(shares), iter(drawn)
        return {
            parameter.name: next(others) if parameter.is_drawn else parameter.value_at(float(next(coming)))
            for parameter in self.parameters
        }

    def draw(self, random: np.random.Generator) -> list[float]:
        """Return values of the parameters that are drawn."""
        return [
            float(random.integers(int(parameter.low), int(parameter.high), endpoint=True))
            for parameter in self.parameters
            if parameter.is_drawn
        ]

    def ending_at(self, seconds: float) -> Space:
        """Return this space once it is known how long a run takes."""
        return Space(
            tuple(
                replace(parameter, high=round(seconds, parameter.digits))
                if math.isinf(parameter.high)
                else parameter
                for parameter in self.parameters
            )
        )


def key_of(case: Case) -> str:
    """Return a text that is equal for equal cases."""
    return json.dumps(case, sort_keys=True)


def parse_range(text: str) -> tuple[str, str, str]:
    """Split `NAME=LOW:HIGH`.

    Raises:
        UsageError: it is not of this form.
    """
    name, _, span = (part.strip() for part in text.partition("="))
    low, _, high = (part.strip() for part in span.partition(":"))
    if not (name and low and high):
        raise UsageError(f"--vary: {text!r} is incomplete; write NAME=LOW:HIGH, such as noise=0:0.01")
    return name, low, high


def number_from(text: str, of: str) -> float:
    """Read a number.

    Raises:
        UsageError: it is none.
    """
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"--vary {of}: {text!r} is not a number") from None


# ------------------------------------------------------------------------------------------------ simulations

_KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
_FORMS: Final = "noise=0:0.01, seed=0:999, start, start=0.02, start.OBJECT=0.02, drop@T, slip@T or slip@2s:9s"


class SimulatedCase(NamedTuple):
    """The run of a case: its samples, what writes it as a log, and the unit of lengths in it, if declared."""

    trace: Trace
    write: Callable[[Path], None]
    unit: str = ""


def scenario_simulation(
    scenario: str,
    files: Sequence[Specification],
    vary: str | Sequence[str],
    options: Sequence[str] = (),
    *,
    is_planned: bool = False,
) -> tuple[Simulation, tuple[Parameter, ...]]:
    """Return the runs of a scenario, and what is varied in them; by default where objects start.

    Args:
        vary: as on the command line.
        options: those of `record` that give the specifications: files, constants.

    Raises:
        UsageError: there is no such scenario, no simulator, or what cannot be varied.
        SpecificationError: names that the world does not have.
    """
    specifications = tuple(files) or (default_specification(scenario),)
    with closing(make_world(scenario)) as world:
        refuse_unknown_names(specifications, world.sample())
    refuse_templates(specifications)
    runs = ScenarioRuns(scenario, specifications, tuple(options), is_planned)
    texts = [vary] if isinstance(vary, str) else vary or ["start"]
    return runs, tuple(parameter for text in texts for parameter in runs.parameters(text))


def own_simulation(
    simulate: Callable[[Mapping[str, float]], Iterable[Sample]],
    files: Sequence[Specification],
    vary: Mapping[str, tuple[float, float]] | Sequence[str],
    jobs: int = 1,
) -> tuple[Simulation, tuple[Parameter, ...]]:
    """Return the runs of a function, and what is varied in them.

    Args:
        vary: ranges by name, or as `NAME=LOW:HIGH`.

    Raises:
        UsageError: no specification or a template, an empty range, or a function that no other process has.
    """
    if not files:
        raise UsageError("a simulation of one's own has no specification yet; give what has to hold")
    refuse_templates(files)
    if not isinstance(vary, Mapping):
        texts = [vary] if isinstance(vary, str) else vary
        vary = {
            name: (number_from(low, name), number_from(high, name))
            for name, low, high in map(parse_range, texts)
        }
    name = getattr(simulate, "__name__", type(simulate).__name__)
    runs = OwnSimulation(simulate, tuple(files), name)
    if jobs > 1:
        try:
            pickle.dumps(runs)
        except (AttributeError, TypeError, pickle.PicklingError) as error:
            raise UsageError(
                f"{name} cannot be sent to other processes ({error}); define it in a module, or take jobs=1"
            ) from None
    return runs, tuple(Parameter.of_range(name_of_range, *span) for name_of_range, span in vary.items())


@dataclass(frozen=True, slots=True)
class OwnSimulation:
    """A simulation of the caller's: a function from the values of a case to samples.

    Equal cases have equal runs.

    Attributes:
        name: what is simulated.
        files: what has to hold.
    """

    simulate: Callable[[Mapping[str, float]], Iterable[Sample]]
    files: tuple[Specification, ...]
    name: str

    @property
    def identity(self) -> Mapping[str, bool]:
        """The other inputs of its runs, for the folder of a search."""
        return {}

    def is_possible(self, case: Case) -> bool:
        """Return whether there is such a run: False where objects would lie in each other."""
        return True

    def run(self, case: Case) -> SimulatedCase:
        """Simulate a case.

        Raises:
            UsageError: the function returns anything but samples.
        """
        values = {name: value for name, value in case.items() if value is not None}
        samples = list(self.simulate(values))
        if not samples or not all(isinstance(sample, Sample) for sample in samples):
            what = f"{type(samples[0]).__name__} objects" if samples else "nothing"
            raise UsageError(f"{self.name} returns {what}; a simulation returns one Sample or more")
        about = {"source": self.name, "options": json.dumps(values)}
        return _simulated_case(samples, self.files, about)

    def command(self, case: Case) -> None:
        """Return the command that repeats the run of a case; None if there is none."""


@dataclass(frozen=True, slots=True)
class ScenarioRuns:
    """The runs of a simulated world.

    Attributes:
        spec_options: those options of `record` that give the specifications: files, constants.
        is_planned: whether a planner decides, for the scenario's own specification, in place of the script.
    """

    name: str
    files: tuple[Specification, ...]
    spec_options: tuple[str, ...]
    is_planned: bool

    @property
    def identity(self) -> Mapping[str, bool]:
        """See `OwnSimulation`."""
        return {"planned": self.is_planned}

    def is_possible(self, case: Case) -> bool:
        """See `OwnSimulation`."""
        starts = {start.name: start for start in _conditions(case)["starts"]}
        scenario = scenario_of(self.name)
        outlines = {
            placement: _outline(placement, starts, scenario.scatter_m) for placement in scenario.placements
        }
        return all(
            least_distance(outlines[placement_a], [outlines[placement_b]]) > 0
            for placement_a, placement_b in combinations(scenario.placements, 2)
            if (placement_a.body.name in starts or placement_b.body.name in starts)
            and _is_beside(placement_a, placement_b)
        )

    def run(self, case: Case) -> SimulatedCase:
        """See `OwnSimulation`."""
        conditions = _conditions(case)
        if self.is_planned:
            return self._plan(conditions)
        samples = simulate_script(self.name, **conditions)
        about = about_run(self.name, **conditions)
        return _simulated_case(samples, self.files, about, unit="m")

    def command(self, case: Case) -> str:
        """See `OwnSimulation`."""
        conditions = _conditions(case)
        options = ["--seed", str(conditions["seed"])]
        if conditions["noise_m"]:
            options += ["--noise", f"{conditions['noise_m']:.12g}"]
        for injection in conditions["injections"]:
            options += ["--inject", str(injection)]
        for start in conditions["starts"]:
            options += ["--start", str(start)]
        # what the planner knows nothing of
        others = ["--also" if word == "--spec" else word for word in self.spec_options]
        verb = ["plan", self.name, *others] if self.is_planned else ["record", self.name, *self.spec_options]
        words = ["spatial-replay", *verb, "-o", "again.mcap", *options]
        return shlex.join(words)

    def _plan(self, given: Conditions) -> SimulatedCase:
        specification = default_specification(self.name)
        task, also = specification, [file for file in self.files if file != specification]
        if self.spec_options and "--spec" not in self.spec_options:
            # values of the constants of the scenario's own specification
            (task,), also = self.files, []
        with TemporaryDirectory() as folder:
            log = Path(folder, "run.mcap")
            record_plan(self.name, log, task, also=also, **given)
            trace, data = read_trace(log), log.read_bytes()

        def write(output: Path) -> None:
            with replacing(output) as stream:
                stream.write(data)

        return SimulatedCase(trace, write, unit="m")

    def parameters(self, text: str) -> list[Parameter]:
        """Return what is varied, as it is written on the command line.

        Raises:
            UsageError: what cannot be varied in this world.
        """
        name = text.partition("=")[0].strip()
        kind, at, when = text.partition("@")
        if at and kind in _KINDS:
            return [self._mishap(kind, when.strip())]
        if name == "start" or name.startswith("start."):
            return self._starts(text)
        if name in ("noise", "seed"):
            _, low, high = parse_range(text)
            ends = number_from(low, name), number_from(high, name)
            refuse_range(name, *ends)
            if ends[0] < 0:
                raise UsageError(f"--vary {text}: {name} is not below 0; begin at 0")
            if name == "noise":
                return [Parameter(name, *ends, digits=6, rest=ends[0], group=name, unit="m")]
            if not all(end.is_integer() for end in ends):
                raise UsageError(f"--vary {text}: seeds are whole numbers; write seed=0:999")
            return [Parameter(name, *ends, digits=0, rest=ends[0], group=name, is_drawn=True)]
        if kind in _KINDS:
            raise UsageError(f"--vary {text}: write {kind}@T for any time of the run, or {kind}@2s:9s")
        hint = nearest_hint(name, ["noise", "seed", "start", *_KINDS])
        raise UsageError(f"--vary: {name!r} cannot be varied in {self.name}; {hint or f'write {_FORMS}'}")

    def _mishap(self, kind: str, when: str) -> Parameter:
        begin, colon, end = when.partition(":")
        try:
            # the world itself says what cannot happen in it
            with closing(make_world(self.name, injections=[Injection.parse(f"{kind}@1s")])):
                pass
            span = (0.0, math.inf)
            if when != "T":
                if not colon:
                    raise UsageError(f"write {kind}@T for any time of the run, or {kind}@2s:9s")
                span = duration_ns_from_text(begin) / 1e9, duration_ns_from_text(end) / 1e9
        except UsageError as error:
            # that a second was tried concerns no one
            why = str(error).removeprefix(f"{kind}@1s: ")
            raise UsageError(f"--vary {kind}@{when}: {why}") from None
        if colon:
            refuse_range(kind, *span)
        return Parameter(kind, *span, digits=3, rest=None, group=kind, unit="s")

    def _starts(self, text: str) -> list[Parameter]:
        name, equals, metres = (part.strip() for part in text.partition("="))
        scenario = scenario_of(self.name)
        bodies = [placement.body.name for placement in scenario.placements]
        body_name = name.removeprefix("start").removeprefix(".")
        if body_name and body_name not in bodies:
            hint = nearest_hint(body_name, bodies) or f"there are {', '.join(bodies)}"
            raise UsageError(f"--vary {text}: {self.name} has no {body_name!r}; {hint}")
        off = number_from(metres, name) if equals else scenario.scatter_m
        if not (math.isfinite(off) and off > 0):
            raise UsageError(
                f"--vary {text}: write how far an object may be from its place, such as {name}=0.02"
            )
        parameters = []
        for placement in scenario.placements:
            if body_name in ("", placement.body.name):
                group = f"start.{placement.body.name}"
                centres = {
                    "x": (placement.x, off),
                    "y": (placement.y, off),
                    "turn": (placement.yaw, scenario.scatter_rad),
                }
                for axis, (centre, wide) in centres.items():
                    digits, unit = (3, "rad") if axis == "turn" else (4, "m")
                    ends = round(centre - wide, digits), round(centre + wide, digits)
                    parameters.append(Parameter(f"{group}.{axis}", *ends, digits, None, group, unit))
        return parameters


Simulation: TypeAlias = OwnSimulation | ScenarioRuns


def _conditions(case: Case) -> Conditions:
    injections = [Injection(kind, round(at * 1e9)) for kind in _KINDS if (at := case.get(kind)) is not None]
    starts = []
    for name in case:
        if name.startswith("start.") and name.endswith(".x"):
            group = name.removesuffix(".x")
            x, y, turn = case[name], case[f"{group}.y"], case[f"{group}.turn"]
            if x is not None and y is not None:
                starts.append(Start(group.removeprefix("start."), x, y, turn))
    seed, noise_m = int(case.get("seed") or 0), case.get("noise") or 0.0
    return Conditions(seed=seed, noise_m=noise_m, injections=injections, starts=starts)


def _outline(placement: Placement, starts: Mapping[str, Start], scatter_m: float) -> Footprint:
    """Return what a body covers at the beginning; with the room that the seed may take."""
    x, y, turn, room = placement.x, placement.y, placement.yaw, scatter_m
    if (start := starts.get(placement.body.name)) is not None:
        x, y, turn, room = start.x, start.y, turn if start.turn is None else start.turn, 0.0
    shape = placement.body.shape
    if isinstance(shape, Box):
        return rectangle(x, y, shape.length + 2 * room, shape.width + 2 * room, turn)
    return Footprint.disc(x, y, shape.radius + room)


def _is_beside(one: Placement, other: Placement) -> bool:
    """Return whether two bodies are at the same height, so that they must not overlap."""
    return (
        one.bottom < other.bottom + other.body.shape.height
        and other.bottom < one.bottom + one.body.shape.height
    )


def _simulated_case(
    samples: Sequence[Sample], files: Sequence[Specification], about: Mapping[str, str], unit: str = ""
) -> SimulatedCase:
    def write(output: Path) -> None:
        with run_log(output, files, about) as log:
            for sample in samples:
                log.write(sample)

    return SimulatedCase(Trace.from_samples(samples), write, unit)
