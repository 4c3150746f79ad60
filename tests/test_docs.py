"""What the documentation and the help say about commands can be typed in."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.util import find_spec
from inspect import cleandoc
from pathlib import Path

import click
import pytest
import yaml

import spatial_replay as sr
from spatial_replay.cli import run as run_in_process
from spatial_replay.cli.application import COMMANDS, application
from spatial_replay.spec.relations import RELATION_NAMES

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
            yield re.split(r" (?:[|>]|\|\|) ", line)[0]


def takes_argument(command: click.Command) -> bool:
    """Whether a command, or a group by itself as `record SCENARIO`, takes an argument."""
    return any(isinstance(parameter, click.Argument) for parameter in command.params)


def leaves(name: str) -> Iterator[tuple[str, click.Command]]:
    """The command of a name, and its subcommands, with their full names."""
    command = application.get_command(click.Context(application), name)
    assert command is not None
    if isinstance(command, click.Group):
        yield from ((f"{name} {inner}", each) for inner, each in command.commands.items())
    if not isinstance(command, click.Group) or takes_argument(command):
        yield name, command


def parse(line: str) -> None:
    """Parse a command line as the program would; raises where it would refuse it."""
    arguments = shlex.split(line, comments=True)[1:]
    command: click.Command | None = application
    while isinstance(command, click.Group) and arguments and not arguments[0].startswith("-"):
        inner = command.get_command(click.Context(command), arguments[0])
        if inner is None and takes_argument(command):
            break
        if inner is None:
            raise click.UsageError(f"{arguments[0]!r} is no command")
        command, arguments = inner, arguments[1:]
    assert command is not None
    command.make_context(command.name, arguments).close()


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


README = (ROOT / "README.md").read_text("utf-8")


def test_the_commands_of_the_readme_run_in_a_clone_with_the_exit_code_they_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(ROOT / "recordings", tmp_path / "recordings")
    monkeypatch.chdir(tmp_path)
    ran = []
    for line in command_lines(README):
        command, _, comment = line.partition("#")
        # a server does not end, and a simulated run takes long and needs an extra: both only have to parse
        if "extra" not in comment:
            code = int(comment.split(":")[0]) if comment else 0
            assert run_in_process(shlex.split(command)[1:]) == code, line
            ran.append(command.split()[1])
    assert set(ran) == {"record", "replay", "explain", "report"}


def test_every_input_that_the_documentation_takes_from_recordings_exists() -> None:
    named = {file for _, line in LINES for file in re.findall(r"(?<![\w/])recordings/[\w./-]+", line)}
    assert named
    assert not {file for file in named if not (ROOT / file).exists()}


def test_the_specification_in_the_readme_has_the_numbers_that_the_readme_shows() -> None:
    text = re.findall(r"^```spatial\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)[0]
    trace = sr.read_trace(ROOT / "recordings" / "table.jsonl")
    in_time = sr.evaluate(sr.parse_specification(text), trace).results[0]
    late = sr.evaluate(sr.parse_specification(text.replace("8s", "4s")), trace).results[0]
    assert f"satisfied by {in_time.robustness:.3f} metres, violated by {-late.robustness:.3f}" in README


@pytest.mark.parametrize("page", ["README.md", "docs/why-did-it-fail.md"])
def test_the_explanation_on_a_page_is_what_the_command_prints(
    page: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / page).read_text("utf-8")
    shown = re.findall(r"^(`laid` is violated.*?)^```$", text, re.MULTILINE | re.DOTALL)
    recordings = ROOT / "recordings"
    files = [str(recordings / "table.jsonl"), "--spec", str(recordings / "table_edited.spatial")]
    assert run_in_process(["explain", *files, "--result", "laid"]) == 1
    assert [each.split() for each in shown] == [capsys.readouterr().out.split()]


def test_every_extra_is_explained_where_one_installs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    install = (ROOT / "docs/install.md").read_text("utf-8")
    for extra in project["optional-dependencies"]:
        assert f"| `{extra}` |" in install
    for dependency in project["dependencies"]:
        name = re.split(r"[<>=~ ;]", dependency)[0]
        assert re.search(rf"^\|[^|]*\b{name}\b", install, re.MULTILINE), name


def test_the_citation_names_this_version_and_the_paper_of_the_logic() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == sr.__version__
    assert citation["references"][0]["doi"] in README


def test_every_relation_is_drawn_where_it_holds_and_where_it_fails() -> None:
    page = (ROOT / "docs/relations.md").read_text("utf-8")
    drawn = re.findall(
        r"^!\[.*: \+.* on the left, \N{MINUS SIGN}.* on the right\]\(relations/(\w+).svg\)", page, re.M
    )
    assert set(drawn) == RELATION_NAMES | {"dist"}


def test_the_tool_draws_the_committed_relations() -> None:
    command = [sys.executable, str(ROOT / "tools/make_relation_figures"), "--check"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout + result.stderr) == (0, "")


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


@pytest.mark.skipif(
    not (find_spec("mkdocs") and find_spec("mkdocstrings") and find_spec("material")),
    reason="mkdocs-material and mkdocstrings are not installed (dependency group `docs`)",
)
def test_the_site_has_every_page_and_public_name_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    # strict: a broken link, anchor or reference is an error
    command = [sys.executable, str(ROOT / "tools/site"), "-o", str(tmp_path / "site")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, ""), result.stdout
    index = (tmp_path / "site/index.html").read_text("utf-8")
    reference = (tmp_path / "site/api.html").read_text("utf-8")
    for page in ROOT.glob("docs/*.md"):
        assert f'href="{page.stem}.html"' in index
    assert 'src="live-report.html"' in index
    assert (tmp_path / "site/live-report.html").stat().st_size > 100_000
    assert (tmp_path / "site/search/search_index.js").exists(), "search works in pages opened from a folder"
    for name in sr.__all__:
        assert name.startswith("_") or f'id="spatial_replay.{name}"' in reference
    for result in ("SpecResult", "Update", "Verified", "Tuning", "Automaton", "Step"):
        assert re.search(rf'id="spatial_replay\.[\w.]+\.{result}"', reference), result
    for page in (tmp_path / "site").rglob("*.html"):
        text = page.read_text("utf-8")
        assert not re.findall(r'<(?:script|img|iframe|source)[^>]*src="(?:https?:)?//', text)
        assert not re.findall(r'<link[^>]*href="(?:https?:)?//', text)


def test_a_tutorial_that_was_run_shows_pictures_tables_and_words(tmp_path: Path) -> None:
    outputs = [
        {"output_type": "stream", "name": "stdout", "text": "\x1b[1mdone\x1b[0m\n"},
        {"output_type": "stream", "name": "stderr", "text": "a warning"},
        {"output_type": "display_data", "data": {"image/png": "iVBORw0KGgo=", "text/plain": "<Figure>"}},
        {"output_type": "execute_result", "data": {"text/html": "<b>table</b>", "text/plain": "table"}},
        {"output_type": "execute_result", "data": {"text/plain": "3"}},
    ]
    cells = [
        {"cell_type": "markdown", "source": ["# Title"]},
        {"cell_type": "code", "source": ["run()"], "outputs": outputs},
    ]
    site = runpy.run_path(str(ROOT / "tools/site"))
    assert site["markdown_of"](cells, tmp_path / "page.md") == (
        "# Title\n\n```python\nrun()\n```\n\n```text\ndone\n```\n\n"
        "![Output of the code above](page-3.png)\n\n"
        '<div class="output"><b>table</b></div>\n\n```text\n3\n```\n'
    )
    assert (tmp_path / "page-3.png").read_bytes() == b"\x89PNG\r\n\x1a\n"
