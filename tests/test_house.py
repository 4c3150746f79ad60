"""The package as it is installed: its names, what it loads, what it depends on."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from importlib.resources import files
from itertools import chain
from pathlib import Path

import pytest

import spatial_replay

PROJECT = Path(__file__).parent.parent / "pyproject.toml"
TOOL = PROJECT.parent / "tools/check_house"


def package_files() -> list[Path]:
    folder = Path(str(files(spatial_replay)))
    return sorted(folder.rglob("*.py"))


def test_the_package_under_test_is_the_installed_one() -> None:
    if "SPATIAL_REPLAY_INSTALLED" in os.environ:
        assert "site-packages" in Path(spatial_replay.__file__).parts
    else:
        assert Path(spatial_replay.__file__).parent == PROJECT.parent / "spatial_replay"


@pytest.mark.parametrize("name", spatial_replay.__all__)
def test_every_public_name_can_be_imported(name: str) -> None:
    assert getattr(spatial_replay, name) is not None
    assert name in dir(spatial_replay)


def test_other_names_raise_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'replay_everything'"):
        _ = spatial_replay.replay_everything


def test_importing_the_package_loads_nothing_but_itself() -> None:
    program = (
        "import sys; before = set(sys.modules); import spatial_replay\n"
        "loaded = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "sys.exit(', '.join(loaded - {'spatial_replay'} - set(sys.stdlib_module_names)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


def test_the_package_is_marked_as_typed() -> None:
    assert (files(spatial_replay) / "py.typed").is_file()


def test_declared_dependencies_match_the_imports() -> None:
    project = tomllib.loads(PROJECT.read_text())["project"]
    required = {name_of(requirement) for requirement in project["dependencies"]}
    optional = {name_of(requirement) for requirement in chain(*project["optional-dependencies"].values())}
    imported = {module for path in package_files() for module in imported_modules(path)}
    # Rerun takes 500 MB, which tests do without
    distributions = {"rerun": ["rerun-sdk"], **packages_distributions()}
    providers = {
        module: {name.lower().replace("_", "-") for name in distributions.get(module, [module])}
        for module in imported - set(sys.stdlib_module_names) - {"spatial_replay"}
    }
    # the plugin is loaded by pytest alone
    undeclared = {
        module for module, names in providers.items() if not names & (required | optional | {"pytest"})
    }
    assert not undeclared
    assert required <= set().union(*providers.values())


def name_of(requirement: str) -> str:
    return re.split(r"[<>=!~;\[ ]", requirement)[0]


def imported_modules(path: Path) -> set[str]:
    """First names of the modules that a file imports, wherever in it."""
    modules: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            modules.add(node.module.partition(".")[0])
    return modules


NEW_MODULE = '''
"""Objects and their neighbours."""
from contextlib import contextmanager


def nearest(nodes, each):
    found = [each for each in nodes if each]
    for here, node in found:
        match node:
            case {"own": own}:
                return own
    return [known := 1]


class Group:
    @property
    def tested(self): ...

    def is_closed(self): ...

    def _reduced(self):
        def kept(): ...

    @contextmanager
    def locked(self): ...

    def feed(self): ...
'''


def test_the_house_limits_names_of_its_dialect_but_not_its_size(tmp_path: Path) -> None:
    pytest.importorskip("grimp")
    tool = tmp_path / "tools/check_house"
    tool.parent.mkdir()
    tool.write_text(
        re.sub(r"(named by a participle|names of DIALECT)\": [\d_]+", r'\1": 0', TOOL.read_text())
    )
    package = tmp_path / "spatial_replay"
    package.mkdir()
    (package / "__init__.py").write_text("from spatial_replay.groups import Group as Group\n")
    (package / "groups.py").write_text(NEW_MODULE)
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)

    check = subprocess.run(
        [sys.executable, str(tool), "--dialect"], capture_output=True, text=True, check=False
    )

    assert check.returncode == 1, check.stderr
    lines = [line for line in check.stdout.splitlines() if line.startswith("spatial_replay/")]
    assert lines == [
        f"spatial_replay/groups.py:{place}"
        for place in ("7: each", "7: found", "8: here", "10: own", "12: known", "21: _reduced", "22: kept")
    ]
    faults = [line for line in check.stdout.splitlines() if "A change that lowers it" in line]
    assert [line.partition(":")[0] for line in faults] == [
        "local variables are bound to names of DIALECT",
        "functions are named by a participle",
    ]
    assert "2 modules\n" in check.stdout


def test_the_house_allows_the_private_option_of_distances_there_alone(tmp_path: Path) -> None:
    pytest.importorskip("grimp")
    tool = tmp_path / "tools/check_house"
    tool.parent.mkdir()
    tool.write_text(TOOL.read_text())
    package = tmp_path / "spatial_replay"
    (package / "geometry").mkdir(parents=True)
    for name in ("__init__.py", "geometry/__init__.py"):
        (package / name).write_text("")
    for name in ("geometry/kernels.py", "geometry/measure.py"):
        (package / name).write_text("OPTIONS = {'_nrt': False}\n")
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)

    check = subprocess.run([sys.executable, str(tool)], capture_output=True, text=True, check=False)

    assert check.returncode == 1, check.stderr
    refusals = [line for line in check.stdout.splitlines() if "is private" in line]
    assert refusals == ["spatial_replay/geometry/measure.py:1: _nrt is private; write a plain kernel"]
