"""Launch files, scenes, supervision, experiments, method benchmarks and the command line."""
