"""The command line without the installed script: ``python -m softgym_envs.cli``."""

from softgym_envs.cli.app import main

main()
