"""Checks of README and docs: `python -m docs.check` looks at links and commands, `--run` also runs the commands."""
