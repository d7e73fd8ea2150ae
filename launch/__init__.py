"""The command line, launch files and scenes, the supervisor of nodes, experiments and
benchmarks."""
