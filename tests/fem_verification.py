"""Record the verification of the soft body, and print the table of the results.

OPENBLAS_NUM_THREADS=1 python -m tests.fem_verification

This runs tests/test_fem_verify_*.py and prints a Markdown table with one row per result;
docs/soft-body-verification.md summarises it. A test records its measurements with `at_most`,
`between` or `near`, which also assert them. The last paragraph of its docstring names the source
after "Source:".
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Record = Callable[[str, Any], None]
"""Pytest's fixture `record_property`."""
KEY = "verified"
"""Values to record: (name, measured, tolerance), plain text that crosses processes."""


def at_most(record: Record, what: str, measured: float, limit: float) -> None:
    """Record an error. Raises AssertionError unless it is within the limit."""
    record(KEY, (what, f"{measured:.2g}", f"at most {limit:g}"))
    assert measured <= limit, f"{what}: {measured:.3g}, at most {limit:g}"


def between(record: Record, what: str, measured: float, low: float, high: float) -> None:
    """Record a value. Raises AssertionError unless it lies in the band."""
    record(KEY, (what, f"{measured:.4g}", f"{low:g} to {high:g}"))
    assert low <= measured <= high, f"{what}: {measured:.6g}, not in {low:g} to {high:g}"


def near(record: Record, what: str, measured: float, wanted: float, relative: float) -> None:
    """Record a value with the expected one. Raises AssertionError unless it is within
    `relative`."""
    record(KEY, (what, f"{measured:.5g}", f"{wanted:.5g} ± {100 * relative:.2g} %"))
    error = abs(measured / wanted - 1.0)
    assert error <= relative, f"{what}: {measured:.6g}, wanted {wanted:.6g}, off by {error:.3g}"


class _Table:
    """Rows of the results of a pytest run."""

    def __init__(self) -> None:
        self.rows: list[str] = []
        self._sources: dict[str, str] = {}
        self._last = ""

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        for item in items:
            text = getattr(getattr(item, "function", None), "__doc__", None) or ""
            source = text.partition("Source:")[2]
            self._sources[item.nodeid] = " ".join(source.split()).rstrip(".")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when != "call":
            return
        name = report.nodeid.partition("::")[2].partition("[")[0]
        file = Path(report.nodeid.partition("::")[0]).stem.removeprefix("test_fem_verify_")
        for key, finding in report.user_properties:
            if key == KEY:
                test = f"`{file}`: `{name}`"
                source = self._sources[report.nodeid] if test != self._last else "″"
                self._last = test
                what, measured, tolerance = finding
                cells = (what, source, measured, tolerance, test)
                self.rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells))


def main() -> int:
    table = _Table()
    files = sorted(str(path) for path in Path(__file__).parent.glob("test_fem_verify_*.py"))
    outcome = pytest.main(["-q", "--timeout=600", *files], plugins=[table])
    print("\n| what | source | measured | tolerance | test |\n|---|---|---|---|---|")
    print("\n".join(f"{row} |" for row in table.rows))
    return int(outcome)


if __name__ == "__main__":
    sys.exit(main())
