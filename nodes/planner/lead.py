"""How far ahead of an exposure the sheet is planned: to the moment when it gets there."""

from __future__ import annotations

MEMORY = 0.05
"""Share of the newest fingertip's age in the mean; at 60 Hz the mean spans a third of a second."""


def next_lead_s(lead_s: float, wanted_s: float, furthest_s: float) -> float:
    """The lead for the next target, from the present one.

    wanted_s: from this fingertip's exposure until the sheet is where its target says.  furthest_s:
    as far as the fingertip says where the finger will be.  The lead follows slowly, so that one
    late fingertip does not make the sheet's time jump.
    """
    return lead_s + MEMORY * (min(max(wanted_s, 0.0), furthest_s) - lead_s)
