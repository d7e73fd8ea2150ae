"""Computations that several nodes share: arrays in, arrays out; no sockets, no clock, no files."""
