"""What a scene's object is made from: meshes and textures in files, and an organ of our own."""
