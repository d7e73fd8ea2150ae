"""Calibrate cameras, arms, projector and sheet offline, from files or from the simulator."""
