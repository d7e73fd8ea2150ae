"""Play, replay, report and export bags (files of recorded topics)."""
