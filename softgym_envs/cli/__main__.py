"""The command line without its script: ``python -m softgym_envs.cli``."""

from softgym_envs.cli.app import main

main()
