"""Export models of the apparatus to other tools, and serve a running graph to viewers."""
