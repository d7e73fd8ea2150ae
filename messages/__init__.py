"""Define the messages of the nodes, the table of topics, and the scene and calibration files."""
