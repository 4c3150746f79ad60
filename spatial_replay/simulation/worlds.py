"""Worlds by name, with their default specifications."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module, resources

from spatial_replay.errors import UsageError
from spatial_replay.simulation.tabletop import Scenario, Tabletop
from spatial_replay.simulation.world import Injection, Start
from spatial_replay.spec import parse_specification
from spatial_replay.spec.formula import Specification

SCENARIOS: tuple[str, ...] = ("push", "pick-place", "table-setting")
"""Each has a module in `scenarios` and a specification next to it."""


def make_world(
    name: str,
    *,
    seed: int = 0,
    noise_m: float = 0.0,
    injections: Sequence[Injection] = (),
    starts: Sequence[Start] = (),
    gui: bool = False,
) -> Tabletop:
    """Create the world of a scenario at time 0; for the arguments see `Tabletop`.

    Raises:
        UsageError: there is no such scenario, or an argument of `Tabletop` is invalid.
    """
    scenario = scenario_of(name)
    return Tabletop(scenario, seed=seed, noise_m=noise_m, injections=injections, starts=starts, gui=gui)


def default_specification(name: str) -> Specification:
    """Return the default specification of a scenario.

    Raises:
        UsageError: there is no such scenario.
    """
    filename = f"{scenario_of(name).name.replace('-', '_')}.spatial"
    file = resources.files("spatial_replay.simulation.scenarios") / filename
    return parse_specification(file.read_text(encoding="utf-8"), filename=filename)


def scenario_of(name: str) -> Scenario:
    """Return the definition of a scenario.

    Raises:
        UsageError: there is no such scenario, or py_trees, which it needs, is not installed.
    """
    if name not in SCENARIOS:
        raise UsageError(f"there is no scenario {name!r}; there are {', '.join(SCENARIOS)}")
    try:
        module = import_module(f"spatial_replay.simulation.scenarios.{name.replace('-', '_')}")
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "py_trees":
            raise
        raise UsageError(
            f"the world {name} needs py_trees, which is not installed: pip install 'spatial-replay[sim]'"
        ) from error
    scenario = module.SCENARIO
    if not isinstance(scenario, Scenario):
        raise TypeError(f"{module.__name__}.SCENARIO is no scenario but {scenario!r}")
    return scenario
