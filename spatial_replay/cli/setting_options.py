"""Settings of a planner on the command line: an option for each, and a file with several."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache, wraps
from importlib.resources import files
from typing import Any

import click

from spatial_replay.cli.options import LogPath, add_options
from spatial_replay.logs.remote import LogFile


@cache
def _properties() -> Mapping[str, Mapping[str, Any]]:
    # read here, so that --help loads no planner
    text = files("spatial_replay.planning").joinpath("settings.schema.json").read_text(encoding="utf-8")
    properties: Mapping[str, Mapping[str, Any]] = json.loads(text)["properties"]
    return properties


def setting_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that change a planner's settings; the command takes what they change as `changes`."""

    @wraps(command)
    def changing(**arguments: Any) -> Any:
        file: LogFile | None = arguments.pop("settings")
        texts = {key: arguments.pop(key) for key in _properties()}
        return command(changes=_changes(file, texts), **arguments)

    options = [
        click.option(
            "--settings",
            metavar="FILE",
            type=LogPath(),
            help="Settings of the planner (YAML); the options below have precedence.",
        )
    ]
    for key, kind in _properties().items():
        what = kind["description"]
        text = f"{what[0].upper()}{what[1:]}."
        options.append(click.option(f"--{key.replace('_', '-')}", key, metavar="VALUE", help=text))
    return add_options(options, changing)


def _changes(file: LogFile | None, texts: Mapping[str, str | None]) -> Mapping[str, Any]:
    """Return what a settings file and options change.

    Raises:
        MissingFileError: there is no such file. UsageError: invalid values.
    """
    given = {key: text for key, text in texts.items() if text is not None}
    if file is None and not given:
        return {}
    # imported here so that --help stays fast
    from spatial_replay.logs.remote import log_file
    from spatial_replay.mapping.yaml_document import read_yaml_text
    from spatial_replay.planning.settings import parse_setting, parse_settings

    changes: dict[str, Any] = {}
    if file is not None:
        changes |= parse_settings(read_yaml_text(file), log_file(file).name)
    for key, text in given.items():
        changes |= parse_setting(key, text)
    return changes
