"""Measure how accurately the sheet followed the simulated finger along one path."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexsheet.launch.bags.report.series import Grid, RunningMoments, Spread
from flexsheet.nodes.arrays import Floats

MAX_CONTACT_HEIGHT_M = 0.001
"""The maximum height (m) above the undeformed object at which the finger counts as in contact.

The pad of a fingertip deforms by about this amount.
"""


class Sizes:
    """An accumulator of the mean, the 95 % quantile and the maximum of positive values.

    The quantile is accurate to 2.3 %, because the values themselves are not stored.
    """

    def __init__(self) -> None:
        self._moments, self._spread = RunningMoments(), Spread(Grid(0, 1.0, 1))

    def add(self, values: Floats) -> None:
        self._moments.add(values)
        for value in values.tolist():
            self._spread.add(0, value)

    def summary(self, scale: float) -> dict[str, float] | None:
        """Return the mean, the 95 % quantile and the maximum, each multiplied by `scale`.

        Return None if no values were added.
        """
        found, p95 = self._moments.summary(scale), self._spread.quantile_s(0.95)
        if found is None or p95 is None:
            return None
        return {"mean": found["mean"], "p95": scale * p95, "max": found["max"]}


class FollowedFinger:
    """An accumulator of the errors of the true sheet relative to the true finger.

    It also counts drop-outs. A drop-out is an interval in which the arms do not follow the finger
    and which contains at least one exposure in contact.
    """

    def __init__(self) -> None:
        self.exposures = self.drop_outs = 0
        self._in_contact = self._followed = 0
        self._distance, self._angle = Sizes(), Sizes()
        self._dropped = False

    def add(
        self, delta_d_m: Floats, delta_theta_rad: Floats, heights_m: Floats, following: Any
    ) -> None:
        """Add the errors of the sheet at n consecutive exposures.

        delta_d_m: position errors (n,).
        delta_theta_rad: angle errors (n,).
        heights_m: heights (n,) of the true finger above the undeformed object, negative below it.
        following: whether both arms follow the finger (n,).
        """
        contact = heights_m <= MAX_CONTACT_HEIGHT_M
        self.exposures += len(contact)
        self._in_contact += int(contact.sum())
        self._followed += int((contact & following).sum())
        self._distance.add(delta_d_m[contact])
        self._angle.add(delta_theta_rad[contact])
        for touches, follows in zip(contact.tolist(), following.tolist(), strict=True):
            if follows:
                self._dropped = False
            elif touches and not self._dropped:
                self._dropped = True
                self.drop_outs += 1

    def figures(self) -> dict[str, Any]:
        """Return a dictionary of figures (numbers) about the errors and drop-outs.

        contact_ratio: fraction of the exposures that are in contact.
        following_ratio: fraction of the exposures in contact at which the arms follow the finger.

        Values that are only defined during contact are None if there was no contact.
        """
        return {
            "contact_ratio": self._in_contact / self.exposures if self.exposures else None,
            "following_ratio": self._followed / self._in_contact if self._in_contact else None,
            "drop_outs": self.drop_outs,
            "contact": {
                "true_delta_d_mm": self._distance.summary(1e3),
                "true_delta_theta_deg": self._angle.summary(float(np.degrees(1.0))),
            },
        }
