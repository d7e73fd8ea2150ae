"""What several nodes compute with: arrays in, arrays out; no sockets, no clock, no files."""
