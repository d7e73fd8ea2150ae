"""The subcommands of `flexsheet`, one file per noun.

Their libraries are imported when a command runs, so that help and `topic list` come at once.
"""
