"""Speed against accuracy of method families: measurement, charts, and choice for a scene."""
