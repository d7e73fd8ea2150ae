"""Check computers, devices, reach and sheet for a scene, with remedies."""
