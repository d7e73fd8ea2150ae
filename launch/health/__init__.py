"""Check the installation, the layout of a scene and the hosts of a graph."""
