"""Export models of the arms and the sheet to other tools, and serve a running graph to viewers."""
