"""Define the messages between nodes, the table of topics, and the scene and calibration files."""
