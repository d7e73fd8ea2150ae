"""Generate the table of tolerances of the apparatus."""

from __future__ import annotations

from flexsheet.nodes.twin.tolerance_table import (
    NOT_SIMULATED,
    Distribution,
    HalfNormal,
    LogNormal,
    LogUniform,
    Normal,
    OneOf,
    Profile,
    Tolerance,
    Uniform,
    expand_key,
    load_tolerances,
)
from website.messages_page import format_table


def render() -> str:
    """Return the table; values that the simulator does not use have a mark."""
    heads = ("parameter", "unit", "`modern`", "`paper`", "source", "calibrated", "source")
    rows = []
    for row in load_tolerances().values():
        mark = " †" if any(path in NOT_SIMULATED for path in expand_key(row.key)) else ""
        paper = "" if row.paper is None else _describe(row, Profile.PAPER, calibrated=False)
        calibrated = "as before"
        if row.calibrated is not None:
            calibrated = _describe(row, Profile.MODERN, calibrated=True)
        cells = (
            f"`{row.key}`{mark}",
            row.unit,
            _describe(row, Profile.MODERN, calibrated=False),
            paper,
            row.source,
            calibrated,
            row.calibrated_source,
        )
        rows.append(tuple(cell.replace("|", "&#124;") for cell in cells))
    return format_table(heads, rows)


def _describe(row: Tolerance, profile: Profile, *, calibrated: bool) -> str:
    given = row.of(profile, calibrated=calibrated)
    each = given if isinstance(given, tuple) else (given,)
    scale = 1.0 if profile in row.frame_periods else row.scale
    text = "; ".join(_format(one, scale) for one in each)
    if row.pair is not None:
        text += f"; each arm + {_format(row.pair, row.scale)}"
    return text


def _format(distribution: Distribution, scale: float) -> str:
    """Format a distribution, with its numbers multiplied by `scale`."""
    match distribution:
        case Normal(mean, sigma):
            return f"N({mean * scale:.4g}, {sigma * scale:.4g})"
        case LogNormal(median, sigma_ln):
            return f"lognormal, median {median * scale:.4g}, σ(ln) {sigma_ln:.4g}"
        case HalfNormal(sigma):
            return f"|N(0, {sigma * scale:.4g})|"
        case Uniform(low, high):
            return f"U({low * scale:.4g}, {high * scale:.4g})"
        case LogUniform(low, high):
            return f"log-U({low * scale:.4g}, {high * scale:.4g})"
        case OneOf(values):
            return " or ".join(
                value if isinstance(value, str) else f"{value * scale:.4g}" for value in values
            )
        case _:
            raise TypeError(f"unknown distribution {distribution!r}")
