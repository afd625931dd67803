"""The command line: ``softgym VERB``. Every verb calls a Python function of the same meaning."""

from softgym_envs.cli.app import main

__all__ = ["main"]
