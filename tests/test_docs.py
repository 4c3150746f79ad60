"""What the documentation and the help say about commands can be typed in."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from inspect import cleandoc
from pathlib import Path

import click
import pytest

from spatial_replay.cli.application import COMMANDS, application

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/*.md"),
        *ROOT.glob("recordings/*.md"),
        *ROOT.glob("schemas/*.md"),
        ROOT / "tools/demo",
    ]
)


def command_lines(text: str) -> Iterator[str]:
    """The calls of the program in a text, each on a line of its own."""
    for line in text.splitlines():
        line = line.strip().removeprefix("$ ").removeprefix("run 0 ").removeprefix("run 1 ")
        if line.startswith("spatial-replay "):
            yield re.split(r" [|>] ", line)[0]


def leaves(name: str) -> Iterator[tuple[str, click.Command]]:
    """The command of a name, or its subcommands, with their full names."""
    command = application.get_command(click.Context(application), name)
    assert command is not None
    if isinstance(command, click.Group):
        yield from ((f"{name} {inner}", each) for inner, each in command.commands.items())
    else:
        yield name, command


def parse(line: str) -> None:
    """Parse a command line as the program would; raises where it would refuse it."""
    arguments = shlex.split(line, comments=True)[1:]
    command: click.Command | None = application
    while isinstance(command, click.Group) and arguments and not arguments[0].startswith("-"):
        command = command.get_command(click.Context(command), arguments[0])
        if command is None:
            raise click.UsageError(f"{arguments[0]!r} is no command")
        arguments = arguments[1:]
    assert command is not None
    command.make_context(command.name, arguments)


LINES = [(page.name, line) for page in PAGES for line in command_lines(page.read_text())]


@pytest.mark.parametrize(("page", "line"), LINES)
def test_command_lines_in_the_documentation_parse(page: str, line: str) -> None:
    parse(line)


LINKS = [
    (page.relative_to(ROOT).as_posix(), target)
    for page in PAGES
    if page.suffix == ".md"
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text())
    if not re.match(r"[a-z]+:", target)
]


@pytest.mark.parametrize(("page", "target"), LINKS)
def test_links_point_to_existing_files(page: str, target: str) -> None:
    path, _, _ = target.partition("#")
    assert not path or (ROOT / page).parent.joinpath(path).exists()


def test_the_links_of_the_readme_are_collected() -> None:
    assert ("README.md", "docs/language.md") in LINKS


@pytest.mark.parametrize("name", COMMANDS)
def test_the_reference_shows_every_command(name: str) -> None:
    reference = (ROOT / "docs/command-line.md").read_text()
    for leaf, _ in leaves(name):
        assert f"spatial-replay {leaf} " in reference


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example_that_parses(name: str) -> None:
    for leaf, command in leaves(name):
        unwrapped = cleandoc(command.help or "").split("\b\n")[1:]
        examples = [line for part in unwrapped if part.startswith("Example") for line in command_lines(part)]
        # the completion's example hands the line to the shell: eval "$(spatial-replay …)"
        assert examples or leaf == "completion"
        for line in examples:
            parse(line)


def test_a_line_that_the_program_refuses_does_not_parse() -> None:
    with pytest.raises(click.UsageError):
        parse("spatial-replay check a.spatial --no-such-option")
    with pytest.raises(click.UsageError):
        parse("spatial-replay chekc a.spatial")
