"""Launch files, scenes, supervisor, experiments, benchmarks of methods, and command line."""
