"""Read the meshes and textures of a scene's object."""
