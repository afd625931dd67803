"""Options and arguments shared by several verbs, and the parsing of their values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from softgym_envs.errors import ConfigError, unknown_name

if TYPE_CHECKING:
    from softgym_envs.robots.base import Robot

PATH: Any = click.Path(path_type=Path)

VERBS = {
    "agents": "train, evaluate",
    "codesign": "codesign",
    "design": "optimise, sensitivity, calibrate",
    "surrogate": "dataset, fit",
}
"""Folder of shipped configurations -> the verbs that read them."""


class Verbs(click.Group):
    """A group whose errors suggest the nearest verb."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        verbs = self.list_commands(ctx)
        if args[0] not in verbs and not args[0].startswith("-"):
            raise click.UsageError(unknown_name("verb", args[0], verbs), ctx)
        return super().resolve_command(ctx, args)


class ConfigFile(click.ParamType):
    """A YAML file, or the name of a shipped configuration of one kind."""

    name = "file|name"

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        path = Path(value)
        if path.exists() or path.suffix in (".yaml", ".yml") or path.name != str(value):
            return path
        from softgym_envs.config import shipped_configs

        names = shipped_configs(self.folder)
        others = [verbs for folder, verbs in VERBS.items() if value in shipped_configs(folder)]
        if value not in names and others:
            raise ConfigError(f"configuration '{value}' is for {' and '.join(others)}; allowed: {', '.join(names)}")
        if value not in names:
            raise ConfigError(unknown_name("configuration file or name", value, names))
        return names[str(value)]

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        from softgym_envs.config import shipped_configs

        found = [CompletionItem(name) for name in shipped_configs(self.folder) if name.startswith(incomplete)]
        return found or [CompletionItem(incomplete, type="file")]


def config(folder: str) -> Callable[[Callable], Callable]:
    """Add ``--config``: a file, or the name of a shipped configuration of one kind."""
    text = "YAML file of the run, or the name of a shipped one (softgym configs)."
    return click.option("--config", type=ConfigFile(folder), required=True, help=text)


folder = click.option("--folder", type=PATH, required=True, help="Folder for the results.")
results_folder = click.option(
    "--folder", type=PATH, help="Folder for the results (default: results/NAME, with the config's name)."
)
overrides = click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
quiet = click.option("--quiet", is_flag=True, help="Hide progress bars.")
as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
design = click.option(
    "--design",
    multiple=True,
    metavar="NAME=VALUE",
    help="Design variable in SI units, or a choice; repeat.",
)
robot_option = click.option(
    "--option", "options_", multiple=True, metavar="NAME=VALUE", help="Robot option; repeat for several."
)


def environment(command: Callable) -> Callable:
    """Add the options that name an environment in place of its ID; `softgym_envs.cli.environments` reads them."""
    for option in (
        click.option("--weights", type=PATH, help="Folder of surrogate weights (default: the shipped ones)."),
        click.option("--task-option", "task_options", multiple=True, metavar="NAME=VALUE", help="Task option; repeat."),
        robot_option,
        click.option("--task", help="Task of --robot: a name or module:Class (default: reach)."),
        click.option("--robot", help="In place of an ID: a robot, or module:Class.", shell_complete=complete_robot),
        click.option("--config", type=ConfigFile("agents"), help="In place of an ID: the configuration of a training."),
    ):
        command = option(command)
    return command


def writers(command: Callable) -> Callable:
    """Add an option for each `softgym_envs.viewer.moment.EpisodeWriter` of installed packages."""
    from softgym_envs.viewer.moment import WRITERS

    for name in sorted(WRITERS):
        command = click.option(f"--{name}", type=PATH, help=WRITERS[name].help)(command)
    return command


def values_of(option: str, pairs: tuple[str, ...]) -> dict[str, Any]:
    """Return the values of ``--option name=value``, read as in a configuration file.

    Raises:
        ConfigError: for a pair without a name or a value.
    """
    from softgym_envs.config import read_value

    return {name: read_value(text) for name, text in _split(option, pairs)}


def run_options(folder: str) -> Callable[[Callable], Callable]:
    """Add the options of a verb that runs a configuration: ``--config``, ``--quiet`` and overrides."""
    return lambda command: config(folder)(quiet(overrides(command)))


class Resumable(click.Abort):
    """Ctrl-C stopped a verb that continues where it stopped when the same command is run again."""


@contextmanager
def resumable() -> Iterator[None]:
    """Mark a block that loses no finished work when Ctrl-C stops it.

    Raises:
        Resumable: instead of KeyboardInterrupt.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise Resumable from None


def complete_environment(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the IDs of environments that begin with ``incomplete``, for completion in the shell."""
    from softgym_envs.envs.registration import ENVIRONMENTS

    return [name for name in ENVIRONMENTS if name.startswith(incomplete)]


def complete_robot(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the names of robots that begin with ``incomplete``, for completion in the shell."""
    from softgym_envs.robots.registry import ROBOTS

    return [name for name in ROBOTS if name.startswith(incomplete)]


def design_of(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Return the design variables of ``--design name=value``: numbers in SI units, or names of choices."""
    values: dict[str, Any] = {}
    for name, text in _split("design", pairs):
        try:
            values[name] = float(text)
        except ValueError:
            values[name] = text  # refused with the variable's bounds unless it names a choice
    return values


def robot_of(name: str, pairs: tuple[str, ...]) -> Robot:
    """Return a robot made with the options of ``--option name=value``.

    Raises:
        ConfigError: for the ID of an environment.
        ValueError: for an unknown robot or a wrong option.
    """
    from softgym_envs.envs.registration import ENVIRONMENTS
    from softgym_envs.robots.registry import make_robot

    if name in ENVIRONMENTS:
        raise ConfigError(f"'{name}' is an environment; its robot is '{ENVIRONMENTS[name].robot}'")

    return make_robot(name, **values_of("option", pairs))


def _split(option: str, pairs: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    for pair in pairs:
        name, separator, text = pair.partition("=")
        if not separator or not name:
            raise ConfigError(f"--{option} '{pair}' must look like name=value")
        yield name, text
