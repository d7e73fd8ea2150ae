"""Run the paper's experiments on a running graph and evaluate the recorded bags."""

from __future__ import annotations

from flexsheet.messages.errors import FlexsheetError


class ExperimentError(FlexsheetError, RuntimeError):
    """Raised for an experiment that failed, or a bag that does not hold its recording."""

    code = "experiment"
    remedy = "Run it on `launch/demo.yaml` first. A bag must be a recording of the same experiment."
