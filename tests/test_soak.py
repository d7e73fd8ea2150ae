"""Test the detection of leaks in the soak benchmark."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.soak import MIB, Sample, findings, process_report


@pytest.mark.parametrize(("own_mib_per_h", "leaks"), [(0.0, False), (20.0, True)])
def test_a_leak_is_detected_by_private_memory(own_mib_per_h: float, leaks: bool) -> None:
    samples = [
        Sample(
            time_s=10.0 * i, pid=1, uss=round(MIB * (50.0 + own_mib_per_h * i / 360.0)),
            rss=100 * MIB, descriptors=9, threads=2, cpu_s=0.1 * i,
        )
        for i in range(360)
    ]  # fmt: skip
    empty: dict[str, Any] = {
        "restarts": {},
        "hangs": {},
        "errors": {},
        "ports": [],
        "last_errors": {},
    }
    found = findings({"processes": {"node": process_report(samples)}, "windows": [], **empty})
    assert [text.startswith("node: memory grows by 20.0 MiB/h") for text in found] == [True] * leaks
