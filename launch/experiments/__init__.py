"""The paper's experiments, driven through the running graph and computed from the recorded bag."""

from __future__ import annotations


class ExperimentError(RuntimeError):
    """An experiment that could not be done, or a bag that does not hold it; the text says why."""
