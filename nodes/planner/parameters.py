"""What can be set of the planner, and the bounds that follow from it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from flexsheet.messages.methods import SheetForceMethod
from flexsheet.messages.scene import NonNegative, Positive
from flexsheet.nodes.models.motion import SheetBounds
from flexsheet.nodes.node import NodeParameters
from flexsheet.nodes.parameter_marks import SheetCalibrationFile
from flexsheet.nodes.planner.easing import JerkBounds
from flexsheet.nodes.planner.motion import PlanSettings
from flexsheet.nodes.planner.yielding import Presents


class PlannerParameters(NodeParameters):
    lead_s: NonNegative | None = Field(
        default=None,
        description="how far ahead of the exposure the sheet is planned; "
        "null: as long as fingertips take, and arrival_s",
    )
    arrival_s: NonNegative = Field(
        default=0.036, description="from a fingertip's publication until the sheet gets there"
    )
    presents: Presents = Field(
        default="curve",
        description="of the object: its force curve, by stretch and by yielding along the normal; "
        "or its stiffness, by stretch alone, as the paper does",
    )
    sheet_calibration: SheetCalibrationFile | None = Field(
        default=None, description="from calibrate sheet; null: ideal rubber of the scene's modulus"
    )
    sheet_force: SheetForceMethod | Literal["auto"] = Field(
        default="auto",
        description="by what ideal rubber is told; auto: as the scene's methods say, else scaled; "
        "a calibration brings its own",
    )
    cache_dir: Path | None = Field(
        default=None, description="of the sheet's force table; null: the user's cache"
    )
    touch_m: float = Field(default=0.0005, description="contact begins this near to the object")
    release_m: Positive = Field(default=0.003, description="contact ends this far from the object")
    oldest_s: Positive = Field(default=0.1, description="an older fingertip is not followed")
    tilt_margin_rad: NonNegative = Field(
        default=0.14, description="how far past the scene's tilt the sheet still follows"
    )
    largest_spin_rad: Positive = Field(
        default=0.35, description="most that rolling may turn the sheet about its normal"
    )
    speed_m_per_s: Positive = 0.18
    acceleration_m_per_s2: Positive = 2.0
    turn_rad_per_s: Positive = 2.0
    turn_acceleration_rad_per_s2: Positive = 12.0
    stretch_rate_per_s: Positive = 0.03
    stretch_acceleration_per_s2: Positive = 0.3
    jerk_m_per_s3: Positive = 60.0
    turn_jerk_rad_per_s3: Positive = 1000.0
    stretch_jerk_per_s3: Positive = 9.0

    def settings(self) -> PlanSettings:
        """What the planner's plan is bound to."""
        return PlanSettings(
            SheetBounds(
                self.speed_m_per_s,
                self.acceleration_m_per_s2,
                self.turn_rad_per_s,
                self.turn_acceleration_rad_per_s2,
                self.stretch_rate_per_s,
                self.stretch_acceleration_per_s2,
            ),
            JerkBounds(self.jerk_m_per_s3, self.turn_jerk_rad_per_s3, self.stretch_jerk_per_s3),
            touch_m=self.touch_m,
            release_m=self.release_m,
            tilt_margin_rad=self.tilt_margin_rad,
            spin_rad=self.largest_spin_rad,
        )
