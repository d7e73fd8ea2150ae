"""Find the unit of a value from the suffix of its name, and format fractions as percentages."""

from __future__ import annotations

UNITS = {
    "metres_per_px": "m/px", "_ns_per_m": "N s/m", "_m_per_s3": "m/s³", "_rad_per_s3": "rad/s³",
    "_per_s3": "1/s³", "_m_per_s2": "m/s²", "_rad_per_s2": "rad/s²", "_per_s2": "1/s²",
    "_m_per_s": "m/s", "_rad_per_s": "rad/s", "_per_s": "1/s", "_n_per_m": "N/m",
    "_kg_per_m3": "kg/m³", "_m_per_n": "m/N", "_m2": "m²", "_hz": "Hz", "_rad": "rad",
    "_deg": "°", "_px": "px", "_kg": "kg", "_pa": "Pa", "_bytes": "bytes", "_ratio": "1",
    "_ms": "ms", "_mm": "mm", "_n": "N", "_m": "m", "_s": "s",
}  # fmt: skip
"""The unit of a value for each suffix of its name.

If one suffix ends with another suffix, the longer suffix is listed first.
"""

MAX_PERCENT_DIGITS = 4
"""The maximum number of digits after the decimal point."""


def find_unit(name: str) -> str:
    """Return the unit of a value from its name: "1" for a ratio, "" if the name has no suffix."""
    return next((unit for end, unit in UNITS.items() if name.endswith(end)), "")


def format_percent(ratio: float, digits: int = 1) -> str:
    """Return a fraction from 0 to 1 as a percentage that is 0 or 100 only if the fraction is.

    A fraction that would be rounded to 0 or 1 gets more digits, such as "99.97 %".

    digits: minimum number of digits after the decimal point.
    """
    exact = ratio in (0.0, 1.0)
    for count in range(digits, MAX_PERCENT_DIGITS + 1):
        text = f"{100.0 * ratio:.{count}f}"
        if exact or float(text) not in (0.0, 100.0):
            return f"{text} %"
    return "less than 0.0001 %" if ratio < 0.5 else "more than 99.9999 %"
