"""Provide models that several nodes need, as functions of arrays without sockets or files."""
