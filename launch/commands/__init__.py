"""The subcommands of `flexsheet`. Each command has its own module.

Commands import libraries only when they run, so that `--help` and short commands start fast.
"""
