"""Test that invalid calibration files are rejected with an error text."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.calibration_file import CalibrationFileError

ROOT = Path(__file__).resolve().parent.parent
WHOLE = next((ROOT / "launch" / "calibrations").glob("*.yaml")).read_text()

HOSTILE = {
    "no UTF-8": b"version: 2\n\xff\xfe",
    "empty": b"",
    "deep": b"version: " + b"[" * 100_000,
    "deep dashes": b"version:\n  " + b"- " * 50_000 + b"1",
    "aliases": b"a: &a [1,1,1]\nversion: 2\nleft: [*a,*a,*a]\n",
    "too large": b"version: 2\na: " + b"x" * (2 << 20),
    "a number that is none": b"version: " + b"9" * 10_000,
    "a date that is none": b"version: 2020-99-99\n",
    "a tag": b"version: !!python/object/apply:os.system [ls]\n",
    "unknown keys": b"version: 2\n" + b"".join(b"k%d: 1\n" % i for i in range(5000)),
}


@pytest.mark.parametrize("name", list(HOSTILE))
def test_it_is_rejected(tmp_path: Path, name: str) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_bytes(HOSTILE[name])
    with pytest.raises(CalibrationFileError) as refused:
        StereoCalibration.load(file)
    assert str(file) in str(refused.value)
    assert len(str(refused.value)) < 2000


@pytest.mark.parametrize(
    ("key", "value"),
    [("fx_px", "1.0e+300"), ("fx_px", ".nan"), ("width_px", "2000000000"), ("square_m", "-1.0"),
     ("reprojection_rms_px", ".inf")],
)  # fmt: skip
def test_an_absurd_number_is_rejected_by_its_key(tmp_path: Path, key: str, value: str) -> None:
    head, found, rest = WHOLE.partition(f"{key}: ")
    assert found
    end = min(rest.index(one) for one in ",}\n" if one in rest)
    file = tmp_path / "calibration.yaml"
    file.write_text(head + found + value + rest[end:])
    with pytest.raises(CalibrationFileError, match=key):
        StereoCalibration.load(file)
    file.write_text(WHOLE)
    StereoCalibration.load(file)
