"""Play, replay, report and export bags."""
