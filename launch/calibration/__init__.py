"""Calibrate the cameras, arms, projector and sheet from files, recordings or the simulator."""
