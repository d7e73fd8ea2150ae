"""How far ahead of an exposure the sheet is planned: to the moment when it gets there."""

from __future__ import annotations

MEMORY = 0.05
"""Share of the newest fingertip's age in the mean; at 60 Hz the mean spans a third of a second."""

LONGEST_S = 0.12
"""As far as fingertips say where they will be."""


def next_lead_s(lead_s: float, age_s: float, arrival_s: float) -> float:
    """The lead for the next target, from the present one.

    age_s: from exposure to when the newest fingertip was published; it grows on a busy machine.
    arrival_s: from there until the sheet is where the target says: transport, and the arms' servo.
    The lead follows slowly, so that one late fingertip does not make the sheet's time jump: it
    never changes by more than MEMORY * LONGEST_S at a time, less than half a frame.
    """
    wanted_s = min(max(age_s + arrival_s, 0.0), LONGEST_S)
    return lead_s + MEMORY * (wanted_s - lead_s)
