"""Check the installation, a scene's layout and the hosts of a graph."""
