"""Models of the apparatus for other tools, and the server for live viewing."""
