"""Read the mesh and texture files of a scene's object."""
