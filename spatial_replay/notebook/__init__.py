"""Values in notebooks: `html` returns a cell's output, `plot` draws with matplotlib.

Both dispatch on the type of the value. A view is imported with the first value of a type
that the view registers. So a formula as HTML loads neither the planner nor matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from importlib import import_module
from types import MappingProxyType
from typing import Any

from spatial_replay.errors import UsageError
from spatial_replay.lazy import Printed

_VIEWS: Mapping[str, str] = MappingProxyType(
    {
        "spatial_replay.automata.automaton": "evaluation_view",
        "spatial_replay.compare.runs": "study_view",
        "spatial_replay.compare.specifications": "study_view",
        "spatial_replay.monitor.result": "evaluation_view",
        "spatial_replay.planning.decisions": "study_view",
        "spatial_replay.planning.maps": "study_view",
        "spatial_replay.planning.read": "study_view",
        "spatial_replay.spec.formula": "evaluation_view",
        "spatial_replay.trace.trace": "evaluation_view",
        "spatial_replay.tuning.tuned": "study_view",
    }
)
"""Modules of views, relative to this package, by the module whose types the view registers.

Packages that import this package register their own views."""


@singledispatch
def html(value: Any) -> str:
    """Return a value as HTML for a notebook's cell.

    Raises:
        UsageError: the type has no view.
    """
    return str(_after_loading_view(html, value)(value))


@html.register
def _(value: Printed) -> str:
    return value._repr_html_()


@singledispatch
def plot(value: Any, *args: Any, **options: Any) -> Any:
    """Draw a value with matplotlib and return the axes.

    Raises:
        UsageError: the type has no view, or matplotlib is not installed.
    """
    return _after_loading_view(plot, value)(value, *args, **options)


def _after_loading_view(function: Any, value: object) -> Any:
    kind = type(value)
    generic = function.registry[object]
    if (view := _VIEWS.get(kind.__module__)) is not None:
        import_module(f".{view}", __name__)
    if (view_function := function.dispatch(kind)) is generic:
        raise UsageError(f"there is no picture of a {kind.__name__}")
    return view_function
