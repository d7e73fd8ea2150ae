"""Play back bags (files of recorded topics), rerun nodes on them, report on and export them."""
