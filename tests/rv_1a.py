"""Name the kinematics and limits of the RV-1A: those of the bridge, and those of the simulator."""

from __future__ import annotations

import numpy as np

from flexsheet.messages.scene import RV_1A
from flexsheet.nodes.arm_bridge.closed_form import ClosedFormKinematics
from flexsheet.nodes.twin.arms import RV_1A_MECHANICS

ARM = ClosedFormKinematics(RV_1A)
JOINT_MIN_RAD, JOINT_MAX_RAD = np.array(RV_1A.min_rad), np.array(RV_1A.max_rad)
JOINT_SPEED_RAD_PER_S = np.array(RV_1A.speed_rad_per_s)
CENTRE_RAD = np.array(RV_1A.start_rad)
ELBOW_ANGLE_RAD, MAX_WRIST_M, FLANGE_M = ARM.elbow_rad, ARM.max_wrist_m, RV_1A.flange_m
forward = ARM.forward
branches = ARM.branches
find_branch = ARM.find_branch
inverse_kinematics = ARM.inverse_kinematics
solve_joints_on_branch = ARM.solve_joints_on_branch
solve_next_joints = ARM.solve_next_joints

twin_forward = RV_1A_MECHANICS.forward
solve_inverse_kinematics = RV_1A_MECHANICS.solve_inverse_kinematics
RANGE_RAD = RV_1A_MECHANICS.range_rad
SPEED_RAD_PER_S = RV_1A_MECHANICS.speed_rad_per_s
ACCELERATION_RAD_PER_S2 = RV_1A_MECHANICS.acceleration_rad_per_s2
