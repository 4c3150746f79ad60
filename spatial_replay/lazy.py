"""Lazy imports: names of a package, and displays of values in notebooks."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from html import escape
from importlib import import_module
from pathlib import Path
from typing import Any


def lazy_attributes(package: dict[str, Any]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the `__getattr__` and `__dir__` of a package (PEP 562).

    Imports for type checkers in the package's source give the module of each name in `__all__`.

    Args:
        package: `globals()` of the package, which gets the loaded names.
    """
    home = package["__name__"]

    @cache
    def modules() -> dict[str, str]:
        # imports for type checkers do not run, so they are read from the source
        syntax_tree = ast.parse(Path(package["__file__"]).read_text(encoding="utf-8"))
        imports = (node for node in ast.walk(syntax_tree) if isinstance(node, ast.ImportFrom))
        return {alias.name: node.module or "" for node in imports for alias in node.names}

    def load(name: str) -> Any:
        if name not in package["__all__"]:
            raise AttributeError(f"module {home!r} has no attribute {name!r}")
        package[name] = getattr(import_module(modules()[name]), name)
        return package[name]

    def names() -> list[str]:
        return sorted({*package, *package["__all__"]})

    return load, names


class Displayed:
    """A value that `spatial_replay.notebook` can display.

    The package `notebook` imports the values. Values therefore import `notebook` only for a display.
    """

    __slots__ = ()

    def plot(self, *args: Any, **options: Any) -> Any:
        """Draw this value with matplotlib. `spatial_replay.notebook.plot` has the options of each type."""
        return _notebook().plot(self, *args, **options)

    def _repr_html_(self) -> str:
        return str(_notebook().html(self))


class Printed:
    """A result with one text, for terminals and notebooks."""

    __slots__ = ()

    def lines(self) -> Iterator[str]:
        """Yield the text."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        return page_of(self.lines())


def page_of(lines: Iterable[str]) -> str:
    """Return lines of text as HTML."""
    return f'<pre style="white-space:pre-wrap">{escape(chr(10).join(lines))}</pre>'


def _notebook() -> Any:
    return import_module("spatial_replay.notebook")


def data_frame(value: object) -> Any:
    """Return results as a pandas DataFrame; see `spatial_replay.notebook.evaluation_view`."""
    return import_module("spatial_replay.notebook.evaluation_view").data_frame(value)


def drawn_as_svg(value: Displayed) -> str | None:
    """Return an automaton as SVG; None if it is large, or if Graphviz is missing or fails."""
    drawing: str | None = import_module("spatial_replay.notebook.evaluation_view").automaton_svg(value)
    return drawing
