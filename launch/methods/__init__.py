"""Measure speed and accuracy of interchangeable methods, draw charts, and choose for a scene."""
