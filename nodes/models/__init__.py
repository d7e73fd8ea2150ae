"""Compute what several nodes need, in functions of arrays without sockets, clocks or files."""
