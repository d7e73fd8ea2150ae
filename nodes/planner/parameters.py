"""Define the planner's parameters and the limits that are derived from them."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from flexsheet.messages.methods import ComplianceMode
from flexsheet.messages.scene import NonNegative, Positive, Scene
from flexsheet.nodes.models.motion import SheetBounds
from flexsheet.nodes.node import NodeParameters
from flexsheet.nodes.parameter_marks import SheetCalibrationFile
from flexsheet.nodes.planner.jerk_limiter import JerkBounds


class PlannerParameters(NodeParameters):
    """The parameters of the planner node."""

    prediction_horizon_s: NonNegative | None = Field(
        default=None,
        description="time from the camera exposure to the time for which the sheet is planned, "
        "s; null: the mean age of the fingertip measurements plus the actuation delay is used",
    )
    actuation_delay_s: NonNegative = Field(
        default=0.036,
        description="time from the publication of a fingertip measurement until the sheet has "
        "moved, s, until the arms have measured it",
    )
    compliance_mode: ComplianceMode | None = Field(
        default=None,
        description="rendering of the object's force. force_curve: render the force as a function "
        "of depth; stiffness: match only the stiffness, by the stretch (Furukawa et al. 2007); "
        "constant_stretch: render no force; null: the mode of the scene. For a rigid object, "
        "constant_stretch is always used",
    )

    def choose_compliance(self, scene: Scene) -> ComplianceMode:
        """Return the compliance mode for a scene.

        The result is `constant_stretch` if the object is rigid.
        """
        if scene.object.material is None:
            return "constant_stretch"
        return self.compliance_mode or scene.methods.compliance

    sheet_calibration: SheetCalibrationFile | None = Field(
        default=None,
        description="calibration file from `flexsheet calibrate sheet`; null: the sheet is "
        "modelled as ideal rubber with the modulus in the scene",
    )
    cache_dir: Path | None = Field(
        default=None,
        description="folder of cached tables of the sheet's force; null: the user's cache folder "
        "is used",
    )
    contact_on_m: float = Field(
        default=0.0005, description="distance between finger and sheet at which contact starts, m"
    )
    contact_off_m: Positive = Field(
        default=0.003, description="distance between finger and sheet at which contact ends, m"
    )
    max_age_s: Positive = Field(
        default=0.1, description="maximum age of a fingertip measurement that the planner uses, s"
    )
    tilt_margin_rad: NonNegative = Field(
        default=0.14,
        description="angle by which the sheet may exceed working_range.tilt_rad of the scene, rad",
    )
    max_spin_rad: Positive = Field(
        default=0.35, description="maximum rotation of the sheet about its normal by rolling, rad"
    )
    speed_m_per_s: Positive = Field(
        default=0.18, description="maximum speed of the sheet's centre, m/s"
    )
    acceleration_m_per_s2: Positive = Field(
        default=2.0, description="maximum acceleration of the sheet's centre, m/s^2"
    )
    turn_rad_per_s: Positive = Field(
        default=2.0, description="maximum angular speed of the sheet, rad/s"
    )
    turn_acceleration_rad_per_s2: Positive = Field(
        default=12.0, description="maximum angular acceleration of the sheet, rad/s^2"
    )
    stretch_rate_per_s: Positive = Field(
        default=0.03, description="maximum rate of change of the stretch ratio, 1/s"
    )
    stretch_acceleration_per_s2: Positive = Field(
        default=0.3, description="maximum second derivative of the stretch ratio, 1/s^2"
    )
    jerk_m_per_s3: Positive = Field(
        default=60.0, description="maximum jerk of the sheet's centre, m/s^3"
    )
    turn_jerk_rad_per_s3: Positive = Field(
        default=1000.0, description="maximum angular jerk of the sheet, rad/s^3"
    )
    stretch_jerk_per_s3: Positive = Field(
        default=9.0, description="maximum third derivative of the stretch ratio, 1/s^3"
    )

    @property
    def bounds(self) -> SheetBounds:
        """Return the maximum speeds and accelerations of the sheet."""
        return SheetBounds(
            self.speed_m_per_s,
            self.acceleration_m_per_s2,
            self.turn_rad_per_s,
            self.turn_acceleration_rad_per_s2,
            self.stretch_rate_per_s,
            self.stretch_acceleration_per_s2,
        )

    @property
    def jerks(self) -> JerkBounds:
        """Return the maximum jerks of the sheet."""
        return JerkBounds(self.jerk_m_per_s3, self.turn_jerk_rad_per_s3, self.stretch_jerk_per_s3)
