"""Command line, launch files and scenes, supervision of nodes, experiments, method benchmarks."""
