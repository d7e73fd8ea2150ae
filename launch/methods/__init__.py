"""Measure the speed and accuracy of alternative methods, and choose methods for a scene."""
