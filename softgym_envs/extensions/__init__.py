"""Extensions of the suite: each folder is a package that the core does not know and that no other extension needs.

They register robots, tasks, environments, backends, verbs and the like through the entry points in pyproject.toml, as
a package of anyone does.
"""
