"""Launch files and scenes: read, checked, and resolved into what runs where."""
