"""Test the import package: public names, one name per module, and the content of a wheel."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import flexsheet
from flexsheet.messages.errors import EXTRAS, describe_error
from tests.waiting import DEADLINE_S

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("messages", "nodes", "launch")
LINKED = (*FOLDERS, "docker")


def run_python(code: str, cwd: Path, path: str = "") -> str:
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=cwd, env=environment, capture_output=True, text=True, timeout=DEADLINE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", flexsheet.__all__)
def test_each_public_name_is_documented(name: str) -> None:
    value = getattr(flexsheet, name)
    assert value is getattr(flexsheet, name)
    if inspect.isclass(value) or inspect.isfunction(value):
        assert inspect.getdoc(value), f"flexsheet.{name} has no docstring"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'flexsheet' has no attribute 'unknown'"):
        _ = flexsheet.unknown  # type: ignore[attr-defined]


def test_static_and_lazy_names_agree() -> None:
    """Type checkers read the imports. Python reads the table."""
    tree = ast.parse((ROOT / "flexsheet" / "__init__.py").read_text())
    imported = {
        alias.name: node.module
        for branch in ast.walk(tree) if isinstance(branch, ast.If)
        for node in branch.body if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }  # fmt: skip
    assert imported == flexsheet._MODULES
    assert sorted(flexsheet.__all__) == sorted(imported)


def test_importing_the_package_imports_no_library(tmp_path: Path) -> None:
    loaded = json.loads(
        run_python("import flexsheet, json, sys; print(json.dumps(sorted(sys.modules)))", tmp_path)
    )
    assert {"numpy", "zmq", "pydantic", "flexsheet.messages"}.isdisjoint(loaded)


def test_no_module_is_imported_under_two_names(tmp_path: Path) -> None:
    """The checkout, and other packages with the same names, are on the path."""
    for name in FOLDERS:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('foreign package')\n")
    code = (
        "import json, sys, flexsheet\n"
        "for name in flexsheet.__all__: getattr(flexsheet, name)\n"
        "from flexsheet.nodes import NODES, node_class\n"
        "for name in NODES: node_class(name)\n"
        "print(json.dumps(sorted(sys.modules)))"
    )
    path = os.pathsep.join((str(tmp_path), str(ROOT)))
    loaded = json.loads(run_python(code, tmp_path, path).splitlines()[-1])
    assert not [name for name in loaded if name.split(".")[0] in FOLDERS]


def test_sources_import_the_package_by_its_name() -> None:
    wrong = re.compile(rf"^\s*(?:from|import) (?:{'|'.join(FOLDERS)})[. ]", re.MULTILINE)
    for folder in (*FOLDERS, "tests", "benchmarks", "website", "flexsheet"):
        for path in (ROOT / folder).rglob("*.py"):
            found = wrong.search(path.read_text())
            assert found is None, f"{path.relative_to(ROOT)}: {found}"


def test_nothing_changes_the_import_path() -> None:
    for folder in (*FOLDERS, "flexsheet"):
        for path in (ROOT / folder).rglob("*.py"):
            found = re.search(r"\bsys\.(?:path|meta_path)\b", path.read_text())
            assert found is None, f"{path.relative_to(ROOT)}: {found}"


def test_every_module_has_one_file() -> None:
    """The links lead only to the folders beside the package."""
    for name in LINKED:
        assert os.readlink(ROOT / "flexsheet" / name) == f"../{name}"
    for name in FOLDERS:
        module = importlib.import_module(f"flexsheet.{name}")
        assert Path(str(module.__file__)).resolve() == ROOT / name / "__init__.py"


def test_the_launcher_loads_no_numerical_library_of_the_nodes() -> None:
    """The import of SciPy would take half of the start time of a graph."""
    code = (
        "import sys; from flexsheet.nodes import NODES, node_class\n"
        "for name in NODES: node_class(name)\n"
        "print([one for one in sys.modules if one.startswith('scipy.') and one.count('.') == 1"
        " and not one.startswith(('scipy._', 'scipy.version'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_required_packages_are_few_and_each_optional_module_has_an_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert len(project["dependencies"]) <= 14
    assert set(EXTRAS.values()) <= set(project["optional-dependencies"])


OPTIONAL = sorted(EXTRAS)
ARM_COMPUTER = """
import sys
sys.modules.update(dict.fromkeys(sys.argv[1:]))
from pathlib import Path
from flexsheet.launch.plans.plan import load_graph
from flexsheet.nodes import node_class
plan = load_graph(Path("{file}"))
for node in plan.nodes_on("left"):
    node_class(node.type)
"""


def test_the_computer_of_an_arm_needs_no_optional_package(tmp_path: Path) -> None:
    code = ARM_COMPUTER.format(file=ROOT / "launch" / "lab.yaml")
    run_python(f"import sys; sys.argv[1:] = {OPTIONAL}\n{code}", tmp_path, str(ROOT))


def test_the_error_about_a_missing_module_names_its_extra() -> None:
    error = ModuleNotFoundError("No module named 'viser'", name="viser.theme")
    assert describe_error(error).endswith("pip install 'flexsheet[console]'")
