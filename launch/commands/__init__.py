"""Define the subcommands of `flexsheet`, one module per command.

Libraries are imported when a command runs, so that help and `topic list` start fast.
"""
