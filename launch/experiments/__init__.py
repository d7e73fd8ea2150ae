"""The paper's experiments, driven through the running graph and computed from the recorded bag."""

from __future__ import annotations

from flexsheet.messages.errors import FlexsheetError


class ExperimentError(FlexsheetError, RuntimeError):
    """An experiment that could not be done, or a bag that does not hold it; the text says why."""

    code = "experiment"
    remedy = "Run it on `launch/demo.yaml` first. A bag must be a recording of the same experiment."
