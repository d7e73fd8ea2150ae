"""Compare an arm's measured lag and tracking error with the configured and expected values."""

from __future__ import annotations

import numpy as np

from flexsheet.messages.types import SelfCheck, Side
from flexsheet.nodes.models.residuals import ResidualMonitor
from flexsheet.nodes.models.servo_lag import LagEstimate

LAG_THRESHOLD_S = 0.01
"""The maximum deviation (s) of the measured servo lag from the configured lag. It equals five
standard deviations (2 ms each) of a calibrated lag."""

TRACKING_THRESHOLD_RAD = 0.005
"""The maximum difference between the measured tracking error and the tracking error of an ideal
servo that has the measured lag. At a distance of 0.4 m from a joint, the difference corresponds to
2 mm. The largest tabulated backlash (0.6 mrad per joint) has a quarter of this effect."""


class ServoCheck:
    """The self-checks of one arm's servo lag and tracking error.

    configured_lag_s: lag of the arm according to the parameters.
    command_period_s: period of the commands to the arm.

    An overloaded computer sends commands late and reads answers late, which changes the estimated
    lag. The check ignores the part of a lag deviation that such delays can cause.
    """

    def __init__(self, side: Side, configured_lag_s: float, command_period_s: float) -> None:
        self._side, self._configured_lag_s = side, configured_lag_s
        self._command_period_s = command_period_s
        self._lag = ResidualMonitor(1, threshold=LAG_THRESHOLD_S)
        self._tracking = ResidualMonitor(1, threshold=TRACKING_THRESHOLD_RAD)
        self._expected_rad = 0.0

    def update(self, estimate: LagEstimate | None, at_ns: int) -> tuple[SelfCheck, ...]:
        """Update the checks with an estimate of the servo lag, and return their results.

        estimate: new estimate, or None if there is none.
        at_ns: time of the estimate.

        The result is empty until there is enough data.
        """
        if estimate is not None:
            deviation_s = estimate.lag_s - self._configured_lag_s
            # The arm holds a command until the next one, on average half an interval too long. It
            # reads its joint angles at an unknown time between the command and the answer.
            late_s = max(estimate.command_interval_s - self._command_period_s, 0.0)
            error_s = 0.5 * late_s + estimate.answer_delay_s
            excess_s = deviation_s - min(max(deviation_s, -error_s), error_s)
            self._lag.add(np.array([excess_s]), at_ns)
            self._expected_rad = estimate.expected_error_rad
            self._tracking.add(
                np.array([max(estimate.tracking_error_rad - self._expected_rad, 0.0)]), at_ns
            )
        if not self._lag.has_data:
            return ()
        expected_rad = self._expected_rad
        return (
            SelfCheck(
                cause="servo_lag",
                subject=self._side,
                unit="s",
                value=self._configured_lag_s + float(self._lag.mean[0]),
                expected=self._configured_lag_s,
                threshold=LAG_THRESHOLD_S,
                suspected=self._lag.suspected,
            ),
            SelfCheck(
                cause="arm_not_following",
                subject=self._side,
                unit="rad",
                value=expected_rad + float(self._tracking.mean[0]),
                expected=expected_rad,
                threshold=TRACKING_THRESHOLD_RAD,
                suspected=self._tracking.suspected,
            ),
        )
