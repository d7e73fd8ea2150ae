"""The paper's experiments, run on a graph and evaluated from the recorded bags."""

from __future__ import annotations

from flexsheet.messages.errors import FlexsheetError


class ExperimentError(FlexsheetError, RuntimeError):
    """Raised for an experiment that failed, or a bag without the expected recording."""

    code = "experiment"
    remedy = "Try `launch/demo.yaml` first. A bag must be a recording of the same experiment."
