"""What calibration reads: arms' places and pushed sheets, from files or from the twin."""
