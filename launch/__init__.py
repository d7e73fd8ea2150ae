"""What runs where: launch files, scenes, supervisor, experiments, charts, the command line."""
