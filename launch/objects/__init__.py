"""Mesh and texture files of a scene's object."""
