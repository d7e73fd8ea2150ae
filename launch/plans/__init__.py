"""Read and check launch files and scenes, and resolve launch files to graphs."""
