"""A package of your own for softgym-envs: pyproject.toml lists what it adds."""
