"""Test that a wheel is complete: it runs from an environment without a checkout."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.release import (
    PACKAGE_FOLDERS,
    ROOT,
    Environment,
    build,
    install_without_dependencies,
    link_sources,
)

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSION = PROJECT["version"]
PYTHONS = [
    found[1]
    for line in PROJECT["classifiers"]
    if (found := re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", line))
]

READ_ALL = """
import json
from importlib.resources import files
from pathlib import Path

from typer.testing import CliRunner

import flexsheet
from flexsheet.launch.cli import app
from flexsheet.launch.experiments.force_reference import REFERENCE_FILE
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.launch.plans.shipped import LAUNCH_FILES
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.nodes import NODES, node_class
from flexsheet.nodes.console.access_control import HERE
from flexsheet.nodes.renderer.gl import shader_text

PATTERNS = {"launch": "*.yaml", "scene": "scenes/*", "calibration": "calibrations/*",
            "layout": "viewing/*.json", "systemd": "systemd/*", "docker": "../docker/[!.]*"}
paths = {kind: [one.resolve() for one in LAUNCH_FILES.glob(pattern) if one.is_file()]
         for kind, pattern in PATTERNS.items()}
for name in NODES:
    node_class(name)
launched = {}
for path in paths["launch"]:
    done = CliRunner().invoke(app, ["launch", path.stem, "--dry-run", "--json"])
    assert done.exit_code == 0, done.output
    launched[path.stem] = sorted(json.loads(done.stdout)["nodes"])
print(json.dumps({
    "package": flexsheet.__file__,
    "files": {str(kind): [str(one) for one in found] for kind, found in paths.items()},
    "launched": launched,
    "scenes": [load_scene(one).name for one in paths["scene"] if one.suffix == ".yaml"],
    "calibrations": [StereoCalibration.load(one).device for one in paths["calibration"]],
    "shaders": [len(shader_text(one.name, CORRECTED=1, LENS=0, LOOK=0))
                for one in Path(files("flexsheet.nodes.renderer")).glob("*.glsl")],
    "page": [len((HERE / name).read_text()) for name in ("page.css", "page.js")],
    "reference": len(json.loads(REFERENCE_FILE.read_text())),
}))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from the source archive, as `make release` does."""
    folder = tmp_path_factory.mktemp("release")
    sources = link_sources(folder / "sources")
    archive = build(sources, "build_sdist")
    with tarfile.open(archive) as packed:
        # Python 3.11.3 and older have no filters.
        packed.extraction_filter = getattr(tarfile, "data_filter", None)
        packed.extractall(folder)
    return build(folder / archive.name.removesuffix(".tar.gz"), "build_wheel")


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    return install_without_dependencies(wheel, tmp_path_factory.mktemp("environment") / "venv")


def test_the_wheel_contains_every_file_of_the_package(wheel: Path) -> None:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", *PACKAGE_FOLDERS],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if listed.returncode:
        pytest.skip("the tree is no git repository")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name.split("/")[0].split("-")[0] for name in names} == {"flexsheet"}
    tracked = (f"flexsheet/{line}" for line in listed.stdout.split() if (ROOT / line).exists())
    assert sorted(set(tracked) - names) == []


@pytest.mark.long
def test_the_wheel_runs_without_a_checkout(installed: Environment, tmp_path: Path) -> None:
    assert installed.run("flexsheet", "--version", cwd=tmp_path) == f"flexsheet {VERSION}\n"
    read = json.loads(installed.run("python", "-c", READ_ALL, cwd=tmp_path).splitlines()[-1])
    assert Path(read["package"]).is_relative_to(installed.folder)
    shipped = {kind: [Path(one) for one in found] for kind, found in read["files"].items()}
    for kind, found in shipped.items():
        assert found, kind
        assert all(one.is_relative_to(installed.folder.resolve()) for one in found), kind
    assert set(read["launched"]) == {path.stem for path in (ROOT / "launch").glob("*.yaml")}
    assert {"planner", "camera", "renderer"} <= set(read["launched"]["demo"])
    assert len(read["scenes"]) == len(list((ROOT / "launch" / "scenes").glob("*.yaml")))
    assert all(read["calibrations"])
    assert min(read["shaders"] + read["page"] + [read["reference"]]) > 1
    assert len(read["shaders"]) == len(list((ROOT / "nodes" / "renderer").glob("*.glsl")))
    assert any("ExecStart" in path.read_text() for path in shipped["systemd"])
    for path in shipped["docker"]:
        if path.suffix == ".yaml":
            assert YAML(typ="safe").load(path)["services"]
    for path in shipped["layout"]:
        assert json.loads(path.read_text())["configById"]


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("version", PYTHONS)
def test_the_demo_runs_from_the_wheel_with_each_supported_python(
    version: str, wheel: Path, tmp_path: Path
) -> None:
    """pip installs the wheel with its dependencies into an empty environment; the console opens."""
    python = find_python(version)
    if python is None:
        pytest.skip(f"Python {version} is not installed")
    subprocess.run([python, "-m", "venv", tmp_path / "venv"], check=True)
    environment = Environment(tmp_path / "venv")
    environment.run("pip", "install", "--quiet", f"{wheel}[view]", cwd=tmp_path, timeout_s=1200)
    printed = environment.run(
        "flexsheet", "launch", "demo", "--browser", "--json", "--duration", "5", cwd=tmp_path
    )
    assert "console" in json.loads(printed.splitlines()[0])["nodes"]
    assert environment.run("flexsheet", "topic", "list", cwd=tmp_path)


def find_python(version: str) -> Path | None:
    """Return an interpreter of a Python version, of the system or of pyenv."""
    found = shutil.which(f"python{version}")
    candidates = [Path(found)] if found else []
    candidates += sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"), reverse=True)
    check = f"import sys, venv, ensurepip; assert '{version}' == '%d.%d' % sys.version_info[:2]"
    for one in candidates:
        if subprocess.run([one, "-c", check], capture_output=True, check=False).returncode == 0:
            return one
    return None


def test_versions_are_semantic_and_equal() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", VERSION)
    assert f"\nversion: {VERSION}\n" in (ROOT / "CITATION.cff").read_text()
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"
