"""Subcommands of `flexsheet`, one module per command.

Commands import libraries when they run, so that help and `topic list` start quickly.
"""
