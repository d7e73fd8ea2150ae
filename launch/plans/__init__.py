"""Read, check and resolve launch files and scenes."""
