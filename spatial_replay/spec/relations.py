"""Definitions of the spatial relations as expressions.

A relation is a function from terms and parameters to an expression that is positive where the relation
holds. A further relation is a function that is passed to `parse_specification`:

    def near_but_apart(a, b, most):
        return minimum(SignedDistance(a, b), most - SignedDistance(a, b))

    parse_specification("F (cup near_but_apart[0.2] plate)", relations={"near_but_apart": near_but_apart})

The first two parameters are the terms left and right of the name. The other parameters are numbers in
brackets after the name; a number with a default is optional. A parameter with the name `axis` is x, y or z.
`closer` and `between` have three terms and their own syntax.
"""

from __future__ import annotations

import hashlib
import os
import re
import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from math import nan
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeAlias

from spatial_replay.errors import UsageError
from spatial_replay.spec.formula import (
    Axis,
    CentroidProjection,
    ComputedSignal,
    Enlarged,
    Expression,
    Misalignment,
    Projection,
    Protrusion,
    SignedDistance,
    Term,
    minimum,
)

Relation: TypeAlias = Callable[..., Expression]
ComparisonOperator: TypeAlias = Literal["<=", "<", ">=", ">", "=="]

THREE_TERM_RELATIONS: frozenset[str] = frozenset({"closer", "between"})


def compare(quantity: Expression, operator: str, limit: Expression | float) -> Expression:
    """Return the margin of a comparison; strict and non-strict comparisons have the same margin."""
    match operator:
        case "<=" | "<":
            return limit - quantity
        case ">=" | ">":
            return quantity - limit
        case _:
            return minimum(limit - quantity, quantity - limit)


# ------------------------------------------------------------------------------------------- distance


def closeto(a: Term, b: Term, e: float) -> Expression:
    """`a closeto[e] b`: e - sd(a, b), at most `e` apart (Prop. 1)."""
    return e - SignedDistance(a, b)


def farfrom(a: Term, b: Term, e: float) -> Expression:
    """`a farfrom[e] b`: sd(a, b) - e, at least `e` apart (Def. 5)."""
    return SignedDistance(a, b) - e


def touch(a: Term, b: Term, e: float) -> Expression:
    """`a touch[e] b`: min(e - sd, sd + e), at most `e` apart and at most `e` deep (Def. 5)."""
    return minimum(e - SignedDistance(a, b), SignedDistance(a, b) + e)


def ovlp(a: Term, b: Term) -> Expression:
    """`a ovlp b`: -sd(a, b), overlapping (Prop. 1)."""
    return -SignedDistance(a, b)


def closer(a: Term, b: Term, c: Term) -> Expression:
    """`a closer b than c`: sd(a, c) - sd(a, b), nearer to b than to c (Def. 5)."""
    return SignedDistance(a, c) - SignedDistance(a, b)


# ------------------------------------------------------------------------------------------ enclosure


def enclosedin(a: Term, b: Term) -> Expression:
    """`a enclosedin b`: -max over p in hull(a) of sd(p, b), wholly inside b (Prop. 2)."""
    return -Protrusion(a, b)


def partovlp(a: Term, b: Term) -> Expression:
    """`a partovlp b`: min(a ovlp b, -(a enclosedin b)), overlapping but not wholly inside (Def. 5)."""
    return minimum(ovlp(a, b), -enclosedin(a, b))


def moved(a: Term, b: Term, e: float) -> Expression:
    """`a moved[e] b`: -(a enclosedin enlarge(b, e)), a point of a is more than `e` outside of b (Eq. 5)."""
    return -enclosedin(a, Enlarged(b, e))


# ------------------------------------------------------------------------------------------ direction


def prec(a: Term, b: Term, axis: Axis) -> Expression:
    """`a prec[axis] b`: min of b minus max of a along the axis, wholly before b (Def. 8)."""
    return Projection(b, axis, "min") - Projection(a, axis, "max")


def partprec(a: Term, b: Term, axis: Axis) -> Expression:
    """`a partprec[axis] b`: min of b minus min of a along the axis, beginning before b (Def. 8)."""
    return Projection(b, axis, "min") - Projection(a, axis, "min")


def leftof(a: Term, b: Term) -> Expression:
    """`a leftof b`: a prec[x] b, before b along x (Def. 9)."""
    return prec(a, b, "x")


def below(a: Term, b: Term) -> Expression:
    """`a below b`: a prec[y] b, before b along y (Def. 9)."""
    return prec(a, b, "y")


def rightof(a: Term, b: Term) -> Expression:
    """`a rightof b`: -(a leftof b), not left of b (Def. 9)."""
    return -leftof(a, b)


def above(a: Term, b: Term) -> Expression:
    """`a above b`: -(a below b), not below b (Def. 9)."""
    return -below(a, b)


def partleftof(a: Term, b: Term) -> Expression:
    """`a partleftof b`: a partprec[x] b, beginning further left than b (after Def. 9)."""
    return partprec(a, b, "x")


def partbelow(a: Term, b: Term) -> Expression:
    """`a partbelow b`: a partprec[y] b, beginning further down than b (after Def. 9)."""
    return partprec(a, b, "y")


def partrightof(a: Term, b: Term) -> Expression:
    """`a partrightof b`: -(a partleftof b), beginning no further left than b (after Def. 9)."""
    return -partleftof(a, b)


def partabove(a: Term, b: Term) -> Expression:
    """`a partabove b`: -(a partbelow b), beginning no further down than b (after Def. 9)."""
    return -partbelow(a, b)


def between(a: Term, b: Term, c: Term, axis: Axis) -> Expression:
    """`a between[axis] (b, c)`: min(b prec a, a prec c), after b and before c along an axis (Def. 9)."""
    return minimum(prec(b, a, axis), prec(a, c, axis))


def oriented(a: Term, b: Term, k: float) -> Expression:
    """`a oriented[k] b`: k - |u(a) - u(b)|^2 / 2 for the unit orientation vectors u (Def. 10, 11)."""
    return k - Misalignment(a, b)


# --------------------------------------------------------------- as in the published implementation


def closeto_in_pixels(a: Term, b: Term, e: float = 70.0) -> Expression:
    """`a closeto b`: e - sd(a, b); `e` defaults to 70 pixels."""
    return closeto(a, b, e)


def farfrom_in_pixels(a: Term, b: Term, e: float = 150.0) -> Expression:
    """`a farfrom b`: sd(a, b) - e; `e` defaults to 150 pixels."""
    return farfrom(a, b, e)


def touch_in_pixels(a: Term, b: Term, e: float = 5.0) -> Expression:
    """`a touch b`: e - sd(a, b), without a limit on the depth; `e` defaults to 5 pixels."""
    return closeto(a, b, e)


def moved_in_pixels(a: Term, b: Term, e: float = 25.0) -> Expression:
    """`a moved b`: -(a enclosedin enlarge(b, e)); `e` defaults to 25 pixels."""
    return moved(a, b, e)


def _centroid_before(a: Term, b: Term, axis: Axis) -> Expression:
    return CentroidProjection(b, axis, "min") - CentroidProjection(a, axis, "max")


def leftof_by_centroid(a: Term, b: Term) -> Expression:
    """`a leftof b`: least centroid x of b's parts minus greatest centroid x of a's parts."""
    return _centroid_before(a, b, "x")


def below_by_centroid(a: Term, b: Term) -> Expression:
    """`a below b`: least centroid y of b's parts minus greatest centroid y of a's parts."""
    return _centroid_before(a, b, "y")


def rightof_by_centroid(a: Term, b: Term) -> Expression:
    """`a rightof b`: `b leftof a` by centroids."""
    return _centroid_before(b, a, "x")


def above_by_centroid(a: Term, b: Term) -> Expression:
    """`a above b`: `b below a` by centroids."""
    return _centroid_before(b, a, "y")


# ------------------------------------------------------------------------------------------- profiles

_PAPER: Mapping[str, Relation] = MappingProxyType({
    relation.__name__: relation
    for relation in (
        closeto, farfrom, touch, ovlp, closer, enclosedin, partovlp, moved, prec, partprec, leftof, below,
        rightof, above, partleftof, partbelow, partrightof, partabove, between, oriented,
    )
})  # fmt: skip

_PUBLISHED: Mapping[str, Relation] = MappingProxyType(
    {
        **_PAPER,
        "closeto": closeto_in_pixels,
        "farfrom": farfrom_in_pixels,
        "touch": touch_in_pixels,
        "moved": moved_in_pixels,
        "leftof": leftof_by_centroid,
        "below": below_by_centroid,
        "rightof": rightof_by_centroid,
        "above": above_by_centroid,
    }
)

DEFAULT_PROFILE = "paper"

PROFILES: Mapping[str, Mapping[str, Relation]] = MappingProxyType(
    {"paper": _PAPER, "spatial_spec": _PUBLISHED}
)
"""Relations by profile and name; both profiles have the same names."""

RELATION_NAMES: frozenset[str] = frozenset(_PAPER)

# ------------------------------------------------------------------------------------------- plug-ins

PLUGINS_VARIABLE = "SPATIAL_REPLAY_PLUGINS"
"""Environment variable with the plug-ins of `--plugin`, separated as in PATH; child processes inherit it."""
# a pattern instead of tokens, because tokens depend on the relations of plug-ins
_USED = re.compile(r'^[ \t]*use[ \t]+"?([A-Za-z_][\w.]*)"?[ \t]*(?:#.*)?$', re.MULTILINE | re.ASCII)


class Plugin(NamedTuple):
    """User module with further relations and signals.

    Attributes:
        place: file of the module, or its import name.
        sha256: SHA-256 of the file.
        relations: functions from terms and numbers to an expression, by name (`RELATIONS`).
        signals: functions from a `Sample` to a number or None (unknown), by name (`SIGNALS`).
    """

    name: str
    place: str
    sha256: str
    relations: Mapping[str, Relation]
    signals: Mapping[str, Callable[[Any], float | None]]


def used_modules(text: str) -> dict[str, tuple[int, int]]:
    """Return the start and end offsets of plug-ins in `use` lines by name; profiles are left out."""
    return {use[1]: use.span(1) for use in _USED.finditer(text) if use[1] not in PROFILES}


def plugins_of(text: str) -> dict[str, Plugin]:
    """Load all plug-ins of the command line, and further plug-ins that a text uses and the user allows.

    A `use` line alone loads no module, because loading runs code. The user allows a module by `--plugin`, or
    by `[tool.spatial-replay] plugins` in the pyproject.toml of the current folder.

    Raises:
        UsageError: a plug-in cannot be loaded.
    """
    plugin_places = [place for place in os.environ.get(PLUGINS_VARIABLE, "").split(os.pathsep) if place]
    used_names = set(used_modules(text))
    allowed_places = {Path(place).stem if place.endswith(".py") else place: place for place in plugin_places}
    # pyproject.toml is read only if a text needs it
    if used_names - set(allowed_places):
        allowed_places |= {name: name for name in _listed_plugins() if name in used_names}
    return {name: load_plugin(_place(place)) for name, place in allowed_places.items()}


def _listed_plugins() -> list[str]:
    path = Path("pyproject.toml")
    try:
        plugins = (
            tomllib.loads(path.read_text("utf-8"))
            .get("tool", {})
            .get("spatial-replay", {})
            .get("plugins", [])
        )
    except OSError:
        return []
    except (ValueError, AttributeError) as error:
        raise UsageError(f"{path}: [tool.spatial-replay] plugins cannot be read: {error}") from error
    if not isinstance(plugins, list) or not all(isinstance(plugin, str) for plugin in plugins):
        raise UsageError(f'{path}: plugins is {plugins!r}; give a list of modules, such as ["mymodule"]')
    return plugins


def _place(module: str) -> str:
    """Return the file of a module if the current folder has one, else the name of the module."""
    file = Path(module if module.endswith(".py") else f"{module.replace('.', '/')}.py").absolute()
    return str(file) if file.exists() or module.endswith(".py") else module


@cache
def load_plugin(location: str) -> Plugin:
    """Import a plug-in.

    Args:
        location: file of the plug-in, or its import name.

    Raises:
        UsageError: the plug-in cannot be imported, or has neither relations nor signals.
    """
    try:
        if location.endswith(".py"):
            name = Path(location).stem
            module_spec = spec_from_file_location(name, location)
            assert module_spec is not None and module_spec.loader is not None
            module = module_from_spec(module_spec)
            module_spec.loader.exec_module(module)
        else:
            name, module = location, import_module(location)
        content = Path(module.__file__ or "").read_bytes()
    except Exception as error:
        raise UsageError(
            f"the plug-in {location} cannot be loaded: {type(error).__name__}: {error}"
        ) from error
    relations, signals = getattr(module, "RELATIONS", {}), getattr(module, "SIGNALS", {})
    for table_name, functions in (("RELATIONS", relations), ("SIGNALS", signals)):
        if not isinstance(functions, Mapping) or not all(map(callable, functions.values())):
            raise UsageError(
                f"the plug-in {location} has a {table_name} that is not a dictionary of functions by name"
            )
    if not relations and not signals:
        raise UsageError(f"the plug-in {location} has no relations and signals; define RELATIONS or SIGNALS")
    return Plugin(name, location, hashlib.sha256(content).hexdigest(), dict(relations), dict(signals))


def computed_signal(signal: ComputedSignal, sample: Any) -> float:
    """Return the value of a plug-in's signal in a sample; NaN if it is unknown.

    Raises:
        UsageError: the plug-in raises an error, or returns something other than a number or None.
    """
    try:
        value = load_plugin(signal.plugin).signals[signal.name](sample)
        return nan if value is None else float(value)
    # code of a user may raise any error
    except Exception as error:
        message = f"the plug-in {signal.plugin} fails for the signal {signal.name!r} at {sample.time_ns} ns"
        raise UsageError(f"{message}: {type(error).__name__}: {error}") from error
