"""Whether computers, devices, reach and sheet are fit for a scene, and what to do about it."""
