"""The command line: ``softgym VERB``. Every verb calls the Python function that does the same."""

from softgym_envs.cli.app import main as main
