"""Start, supervise and stop the processes of a graph on one host."""
