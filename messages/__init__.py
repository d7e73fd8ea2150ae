"""Define the messages that nodes exchange, the table of topics, and the scene and calibration
files.
"""
