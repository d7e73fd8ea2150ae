"""Start and measure graphs: command line, launch files, supervision, experiments and benchmarks."""
