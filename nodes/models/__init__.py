"""Compute what several nodes need: arrays in, arrays out; no sockets, no clock, no files."""
