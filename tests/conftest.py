"""Configure all tests."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest
import structlog
from hypothesis import settings

from tests.commands import Command
from tests.examples import USUAL
from tests.shared import FOLDER_VARIABLE

# Node processes import test nodes ("tests.launch_nodes:Beacon") from the repository's root.
ROOT = Path(__file__).resolve().parent.parent
os.environ["PYTHONPATH"] = os.pathsep.join(
    filter(None, (str(ROOT), os.environ.get("PYTHONPATH", "")))
)

# A deadline would assert wall-clock time, and fail on a busy machine.  The examples are the same in
# each run, so that a failure is due to a change: `--hypothesis-profile random` draws others.
settings.register_profile(
    "fixed", deadline=None, derandomize=True, database=None, max_examples=USUAL
)
settings.register_profile("random", deadline=None, print_blob=True)
settings.register_profile("long", deadline=None, print_blob=True, max_examples=1000)
settings.load_profile("fixed")

# By default structlog prints the variables of each frame of an error's traceback, with all numbers
# of their arrays: seconds of processor time for each error.  Processes of nodes print no variables.
structlog.configure(
    processors=[
        *structlog.get_config()["processors"][:-1],
        structlog.dev.ConsoleRenderer(
            colors=False, exception_formatter=structlog.dev.plain_traceback
        ),
    ]
)

LONGEST = (
    "test_three_hosts",
    "test_console_page",
    "test_console_browser",
    "test_graph_interrupted",
)
"""Files with the longest tests, which begin first: none is then left for the end."""

SKIPPED_FILE = "SKIPPED_FILE"
"""Environment variable: the file that gets a line for each skipped test.  `make test` prints it."""


@pytest.fixture
def flexsheet(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Return a function that runs the command in this process."""
    return Command(capsys, monkeypatch)


def pytest_configure(config: pytest.Config) -> None:
    """Create the folder that all processes of a test run share (`tests/shared.py`)."""
    if FOLDER_VARIABLE not in os.environ:
        os.environ[FOLDER_VARIABLE] = tempfile.mkdtemp(prefix="flexsheet-tests-")
        config.add_cleanup(remove_shared_folder)


def remove_shared_folder() -> None:
    shutil.rmtree(os.environ.pop(FOLDER_VARIABLE))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Move the test files in LONGEST to the start. The order of other files does not change."""
    items.sort(key=lambda item: item.path.stem not in LONGEST)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Append "FILE: REASON" for each skipped test to the file in the variable SKIPPED_FILE."""
    path = os.environ.get(SKIPPED_FILE)
    if path is None or hasattr(terminalreporter.config, "workerinput"):
        return
    lines = [
        f"{report.nodeid.partition('::')[0]}: {report.longrepr[2].removeprefix('Skipped: ')}\n"
        for report in terminalreporter.stats.get("skipped", ())
    ]
    with Path(path).open("a", encoding="utf-8") as file:
        file.writelines(lines)
