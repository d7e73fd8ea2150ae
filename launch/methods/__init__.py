"""Speed against accuracy of method families: measured, charted, and chosen for a scene."""
