"""Play back, replay, verify, report on and export bags (files of recorded topics)."""
