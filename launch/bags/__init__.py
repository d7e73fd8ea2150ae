"""Play, replay, report and export bags, which are files of recorded topics."""
