"""Generate documentation pages from the code and finish the site; see `make docs`."""
