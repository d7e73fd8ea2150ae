"""Test the fuzzing targets with hypothesis: inputs are decoded, or rejected with the declared
error.

`make fuzz` runs the same targets for longer.
"""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.fuzz_targets import (
    TARGETS,
    ExecutionMonitor,
    Finding,
    bounded_memory,
    close_fake_arm,
    remove_launch_folder,
)

EXAMPLES = {
    "wire": 150, "bag": 40, "launch": 6, "scene": 6, "mesh": 15, "modbus": 30, "mxt": 30
}  # fmt: skip
"""Number of examples by target; each target takes some tenths of a second to two seconds."""


@pytest.fixture(scope="module", autouse=True)
def _cleared_away() -> Iterator[None]:
    yield
    remove_launch_folder()
    close_fake_arm()


@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning:trimesh", "ignore::DeprecationWarning:trimesh")
def test_changed_input_is_understood_or_rejected(name: str) -> None:
    target = TARGETS[name]
    # Of YAML the smallest, which is slow to read already.
    seeds = sorted(target.seeds(), key=len)[: 1 if name in ("launch", "scene") else None]

    @settings(
        max_examples=EXAMPLES[name],
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],
        derandomize=True,
    )
    @given(st.integers(0, 2**32), st.sampled_from(seeds), st.integers(1, 4))
    def changed(number: int, data: bytes, times: int) -> None:
        chance = random.Random(number)
        for _ in range(times):
            data = target.mutate(data, chance)
        target.check(data)

    for seed in seeds:
        target.check(seed)
    changed()


@pytest.mark.parametrize("name", ["wire", "bag", "modbus"])
def test_valid_examples_are_understood(name: str) -> None:
    target = TARGETS[name]
    assert any(target.check(seed) for seed in target.seeds())


def test_execution_and_excessive_memory_are_found() -> None:
    with pytest.raises(Finding, match=r"os\.system"), ExecutionMonitor.looks():
        __import__("os").system("true")
    with pytest.raises(Finding, match="MiB"), bounded_memory(-1):
        pass
