"""Subcommands of `flexsheet`, one module per command.

Commands import libraries only when they run, so that `--help` and short commands start fast.
"""
