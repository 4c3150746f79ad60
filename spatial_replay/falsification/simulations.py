"""Simulations to search, with their varied parameters: scenarios, and functions of users."""

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
"""Value of each parameter by name; None for a parameter without a value."""

Range: TypeAlias = tuple[float, float]

TENTHS: Final = 10
"""Number of parts of a range; runs are counted in each part."""
_DIGITS: Final = 6
"""Digits of a value relative to the width of its range, if the parameter has no fixed resolution."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """Varied number.

    Attributes:
        low, high: range; for a time in a run, `high` is infinite until the first run has ended.
        digits: decimals of a rounded value, so that a written value is read back exactly.
        rest: value in the run without variations; None if the parameter has no value in that run.
        group: name of a group of parameters, which a search resets to rest together.
        unit: "m", "rad", "s", or "".
        is_drawn: whether values are drawn instead of optimised. Seeds are drawn, because they have no order.
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
        """Return a parameter of a user's simulation; its value at rest is the value nearest to 0.

        Raises:
            UsageError: the range is empty or not finite.
        """
        low, high = float(low), float(high)
        refuse_range(name, low, high)
        digits = max(0, _DIGITS - math.floor(math.log10(high - low)))
        return cls(name, low, high, digits, min(max(low, 0.0), high), name)

    def value_at(self, share: float) -> float:
        """Return the value at a fraction of the range, from 0 to 1."""
        value = round(self.low + share * (self.high - self.low), self.digits)
        # rounding may leave the range; + 0.0 turns -0.0 into 0.0
        return min(max(value, self.low), self.high) + 0.0

    def tenth_of(self, value: float) -> int:
        """Return the tenth of the range that contains a value, from 0."""
        return min(TENTHS - 1, int(TENTHS * (value - self.low) / (self.high - self.low)))

    def text_of(self, value: float) -> str:
        """Return a value with name, unit and all digits; fewer digits would be another case."""
        number = f"{value:.12g}"
        if self.unit == "s":
            return f"{self.name}@{number}s"
        return f"{self.name} {number} {self.unit}".rstrip()


def refuse_range(name: str, low: float, high: float) -> None:
    """Raise an error for an invalid range.

    Raises:
        UsageError: the range is empty or not finite.
    """
    for end in (low, high):
        if not math.isfinite(end):
            raise UsageError(f"--vary {name}: {end:g} is not an end of a range; write a finite number")
    if low >= high:
        raise UsageError(f"--vary {name}: {low:g} to {high:g} is not a range; write the lower end first")


@dataclass(frozen=True, slots=True)
class Space:
    """Space of all varied parameters."""

    parameters: tuple[Parameter, ...]

    @property
    def ordered(self) -> tuple[Parameter, ...]:
        """The parameters with ordered values, which an optimiser can use."""
        return tuple(parameter for parameter in self.parameters if not parameter.is_drawn)

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups in the order of reduction: mishaps, numbers, starts; seeds cannot be reduced."""
        sorted_parameters = sorted(
            self.ordered, key=lambda parameter: (parameter.unit != "s", parameter.rest is None)
        )
        return tuple(dict.fromkeys(parameter.group for parameter in sorted_parameters))

    def at_rest(self, case: Case | None = None, group: str | None = None) -> dict[str, float | None]:
        """Return a case with one group at rest; without a case, return the case with all groups at rest."""
        return {
            parameter.name: parameter.rest
            if case is None or parameter.group == group
            else case[parameter.name]
            for parameter in self.parameters
        }

    def nearer(self, case: Case, group: str) -> dict[str, float | None] | None:
        """Return a case with a group half way to rest; None if the group is at rest or lacks a rest value."""
        new_case = dict(case)
        for parameter in self.parameters:
            value = case[parameter.name]
            if parameter.group == group:
                if parameter.rest is None or value is None:
                    return None
                new_case[parameter.name] = round((value + parameter.rest) / 2, parameter.digits)
        return None if new_case == dict(case) else new_case

    def case_at(self, shares: Iterable[float], drawn: Sequence[float]) -> dict[str, float | None]:
        """Return the case at fractions of the ordered parameters' ranges, and with drawn values."""
        ordered_shares, drawn_values = iter(shares), iter(drawn)
        return {
            parameter.name: next(drawn_values)
            if parameter.is_drawn
            else parameter.value_at(float(next(ordered_shares)))
            for parameter in self.parameters
        }

    def draw(self, random: np.random.Generator) -> list[float]:
        """Return random values of the drawn parameters."""
        return [
            float(random.integers(int(parameter.low), int(parameter.high), endpoint=True))
            for parameter in self.parameters
            if parameter.is_drawn
        ]

    def ending_at(self, seconds: float) -> Space:
        """Return the space with the duration of a run as the upper end of infinite ranges."""
        return Space(
            tuple(
                replace(parameter, high=round(seconds, parameter.digits))
                if math.isinf(parameter.high)
                else parameter
                for parameter in self.parameters
            )
        )


def key_of(case: Case) -> str:
    """Return a key that is equal for equal cases."""
    return json.dumps(case, sort_keys=True)


def parse_range(text: str) -> tuple[str, str, str]:
    """Split `NAME=LOW:HIGH`.

    Raises:
        UsageError: the text has another form.
    """
    name, _, range_text = (part.strip() for part in text.partition("="))
    low_text, _, high_text = (part.strip() for part in range_text.partition(":"))
    if not (name and low_text and high_text):
        raise UsageError(f"--vary: {text!r} is incomplete; write NAME=LOW:HIGH, such as noise=0:0.01")
    return name, low_text, high_text


def number_from(text: str, of: str) -> float:
    """Return the number of a text.

    Raises:
        UsageError: the text is not a number.
    """
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"--vary {of}: {text!r} is not a number") from None


# ------------------------------------------------------------------------------------------------ simulations

_KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
_FORMS: Final = "noise=0:0.01, seed=0:999, start, start=0.02, start.OBJECT=0.02, drop@T, slip@T or slip@2s:9s"


class SimulatedCase(NamedTuple):
    """Run of a case: its samples, a function that writes its log, and the declared unit of lengths or ""."""

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
    """Return the simulation of a scenario and its varied parameters, by default the starts of objects.

    Args:
        vary: parameters as on the command line.
        options: options of `record` for the specifications: files, constants.

    Raises:
        UsageError: an unknown scenario, a missing simulator, or a parameter that cannot be varied.
        SpecificationError: a specification mentions objects that the world does not have.
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
    """Return the simulation of a user's function and its varied parameters.

    Args:
        vary: ranges by name, or texts `NAME=LOW:HIGH`.

    Raises:
        UsageError: no specification, a template, an empty range, or a function that other processes cannot
            import.
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
    simulation = OwnSimulation(simulate, tuple(files), name)
    if jobs > 1:
        try:
            pickle.dumps(simulation)
        except (AttributeError, TypeError, pickle.PicklingError) as error:
            raise UsageError(
                f"{name} cannot be sent to other processes ({error}); define it in a module, or take jobs=1"
            ) from None
    return simulation, tuple(Parameter.of_range(name_of_range, *ends) for name_of_range, ends in vary.items())


@dataclass(frozen=True, slots=True)
class OwnSimulation:
    """Simulation by a user's function from the values of a case to samples.

    Equal cases have equal runs.

    Attributes:
        name: name of the simulation.
        files: specifications of the runs.
    """

    simulate: Callable[[Mapping[str, float]], Iterable[Sample]]
    files: tuple[Specification, ...]
    name: str

    @property
    def identity(self) -> Mapping[str, bool]:
        """Further inputs of the runs; a folder belongs to a search with equal inputs."""
        return {}

    def is_possible(self, case: Case) -> bool:
        """Return whether a case has a run; False if objects would overlap at the start."""
        return True

    def run(self, case: Case) -> SimulatedCase:
        """Simulate a case.

        Raises:
            UsageError: the function returns something other than samples.
        """
        case_values = {name: value for name, value in case.items() if value is not None}
        samples = list(self.simulate(case_values))
        if not samples or not all(isinstance(sample, Sample) for sample in samples):
            result_text = f"{type(samples[0]).__name__} objects" if samples else "nothing"
            raise UsageError(f"{self.name} returns {result_text}; a simulation returns one Sample or more")
        metadata = {"source": self.name, "options": json.dumps(case_values)}
        return _simulated_case(samples, self.files, metadata)

    def command(self, case: Case) -> None:
        """Return the command that records the run of a case; None for a user's simulation."""


@dataclass(frozen=True, slots=True)
class ScenarioRuns:
    """Simulation of a scenario.

    Attributes:
        spec_options: options of `record` for the specifications: files, constants.
        is_planned: whether the planner acts instead of the script. The planner's goal is the scenario's
            specification.
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
        metadata = about_run(self.name, **conditions)
        return _simulated_case(samples, self.files, metadata, unit="m")

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
        # the planner plans for the scenario's specification; other files are only evaluated
        plan_options = ["--also" if word == "--spec" else word for word in self.spec_options]
        command_words = (
            ["plan", self.name, *plan_options]
            if self.is_planned
            else ["record", self.name, *self.spec_options]
        )
        words = ["spatial-replay", *command_words, "-o", "again.mcap", *options]
        return shlex.join(words)

    def _plan(self, conditions: Conditions) -> SimulatedCase:
        specification = default_specification(self.name)
        task_specification, other_specifications = (
            specification,
            [file for file in self.files if file != specification],
        )
        if self.spec_options and "--spec" not in self.spec_options:
            # without --spec, the only file is the scenario's specification with other constants
            (task_specification,), other_specifications = self.files, []
        with TemporaryDirectory() as folder:
            log = Path(folder, "run.mcap")
            record_plan(self.name, log, task_specification, also=other_specifications, **conditions)
            trace, log_content = read_trace(log), log.read_bytes()

        def write(output: Path) -> None:
            with replacing(output) as stream:
                stream.write(log_content)

        return SimulatedCase(trace, write, unit="m")

    def parameters(self, text: str) -> list[Parameter]:
        """Return the parameters for a text of the command line.

        Raises:
            UsageError: a parameter that cannot be varied in this world.
        """
        name = text.partition("=")[0].strip()
        kind, at_sign, time_text = text.partition("@")
        if at_sign and kind in _KINDS:
            return [self._mishap(kind, time_text.strip())]
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

    def _mishap(self, kind: str, time_text: str) -> Parameter:
        begin_text, colon, end_text = time_text.partition(":")
        try:
            # the world refuses injections that cannot happen in it
            with closing(make_world(self.name, injections=[Injection.parse(f"{kind}@1s")])):
                pass
            range_s = (0.0, math.inf)
            if time_text != "T":
                if not colon:
                    raise UsageError(f"write {kind}@T for any time of the run, or {kind}@2s:9s")
                range_s = duration_ns_from_text(begin_text) / 1e9, duration_ns_from_text(end_text) / 1e9
        except UsageError as error:
            # the message omits 1 s, the time of the check, because the user did not write it
            reason = str(error).removeprefix(f"{kind}@1s: ")
            raise UsageError(f"--vary {kind}@{time_text}: {reason}") from None
        if colon:
            refuse_range(kind, *range_s)
        return Parameter(kind, *range_s, digits=3, rest=None, group=kind, unit="s")

    def _starts(self, text: str) -> list[Parameter]:
        name, equals_sign, distance_text = (part.strip() for part in text.partition("="))
        scenario = scenario_of(self.name)
        body_names = [placement.body.name for placement in scenario.placements]
        body_name = name.removeprefix("start").removeprefix(".")
        if body_name and body_name not in body_names:
            hint = nearest_hint(body_name, body_names) or f"there are {', '.join(body_names)}"
            raise UsageError(f"--vary {text}: {self.name} has no {body_name!r}; {hint}")
        distance_m = number_from(distance_text, name) if equals_sign else scenario.scatter_m
        if not (math.isfinite(distance_m) and distance_m > 0):
            raise UsageError(
                f"--vary {text}: write how far an object may be from its place, such as {name}=0.02"
            )
        parameters = []
        for placement in scenario.placements:
            if body_name in ("", placement.body.name):
                group = f"start.{placement.body.name}"
                ranges_by_axis = {
                    "x": (placement.x, distance_m),
                    "y": (placement.y, distance_m),
                    "turn": (placement.yaw, scenario.scatter_rad),
                }
                for axis, (centre, half_width) in ranges_by_axis.items():
                    digits, unit = (3, "rad") if axis == "turn" else (4, "m")
                    ends = round(centre - half_width, digits), round(centre + half_width, digits)
                    parameters.append(Parameter(f"{group}.{axis}", *ends, digits, None, group, unit))
        return parameters


Simulation: TypeAlias = OwnSimulation | ScenarioRuns


def _conditions(case: Case) -> Conditions:
    injections = [
        Injection(kind, round(time_s * 1e9)) for kind in _KINDS if (time_s := case.get(kind)) is not None
    ]
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
    """Return a body's footprint at its start in `starts`.

    Without a start, return the footprint at its placement, enlarged by the scatter of seeds.
    """
    x, y, yaw, room_m = placement.x, placement.y, placement.yaw, scatter_m
    if (start := starts.get(placement.body.name)) is not None:
        x, y, yaw, room_m = start.x, start.y, yaw if start.turn is None else start.turn, 0.0
    shape = placement.body.shape
    if isinstance(shape, Box):
        return rectangle(x, y, shape.length + 2 * room_m, shape.width + 2 * room_m, yaw)
    return Footprint.disc(x, y, shape.radius + room_m)


def _is_beside(first_placement: Placement, second_placement: Placement) -> bool:
    """Return whether two bodies overlap in height, so that their footprints must not overlap."""
    return (
        first_placement.bottom < second_placement.bottom + second_placement.body.shape.height
        and second_placement.bottom < first_placement.bottom + first_placement.body.shape.height
    )


def _simulated_case(
    samples: Sequence[Sample], files: Sequence[Specification], metadata: Mapping[str, str], unit: str = ""
) -> SimulatedCase:
    def write(output: Path) -> None:
        with run_log(output, files, metadata) as log:
            for sample in samples:
                log.write(sample)

    return SimulatedCase(Trace.from_samples(samples), write, unit)
