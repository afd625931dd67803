"""Entry point of the command line: its verbs, and errors reported as one line with status 2."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import sys
from collections.abc import Sequence
from typing import NoReturn

import click

from softgym_envs.cli.options import Resumable, Verbs
from softgym_envs.errors import SoftGymError
from softgym_envs.extras import explain
from softgym_envs.registry import Table, allow_code, is_place
from softgym_envs.version import __version__

ALLOW = "--allow-code"
"""Flag of all verbs: files may name code, and the current folder is on the search path."""

JSON = "--json"
"""Flag of all verbs: print one line of JSON. Verbs without an option of this name print what `_print_json` says."""

SECTIONS = {
    "Environments": {
        "list": "environments:list_",
        "rollout": "environments:rollout",
    },
    "Robots": {
        "show": "robots:show",
    },
    "Agents": {
        "train": "agents:train",
        "evaluate": "agents:evaluate",
    },
    "Design and control": {
        "demo": "demo:demo",
        "codesign": "codesign:codesign",
    },
    "Configurations": {
        "configs": "configs:configs",
    },
}
"""Title in the help -> verb -> its place in `softgym_envs.cli`."""

VERBS = Table(
    "verb",
    {verb: f"softgym_envs.cli.{place}" for verbs in SECTIONS.values() for verb, place in verbs.items()},
    group="softgym_envs.verbs",
)
"""All verbs by name, which are `click` commands: those of `SECTIONS` and those of installed packages."""


class _Verbs(Verbs):
    """The group of all verbs, whose help lists them by section; a verb is imported when it is used or listed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        return VERBS[cmd_name] if cmd_name in VERBS else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, VERBS))  # all sections share the same two columns
        others = set(VERBS).difference(*SECTIONS.values())
        for title, verbs in {**SECTIONS, "Extensions": sorted(others)}.items():
            with formatter.section(title):
                formatter.write_dl([(f"{verb:{width}}", VERBS[verb].get_short_help_str(80)) for verb in verbs])


@click.group(
    cls=_Verbs,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(__version__, prog_name="softgym")
@click.pass_context
def cli(ctx: click.Context) -> None:
    """Optimise the body and the controller of a soft robot together.

    Files name robots, tasks, metrics, ... that are registered. With --allow-code, in any place, they may also name
    code of yours as module:name, which is looked up in the current folder too. With --json, every verb prints one line
    of JSON; one that has no --json of its own prints its result, if it has one, and the lines that people would read.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


def main() -> None:
    """Run the command line; an error in the user's input ends it with one line and status 2."""
    import gymnasium
    from threadpoolctl import threadpool_limits

    # One thread per process: more threads slow down these small problems. The variables affect libraries loaded later
    # and worker processes; the limit affects libraries that are already loaded.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    threadpool_limits(1)
    arguments = [argument for argument in sys.argv[1:] if argument != ALLOW]
    as_json = JSON in arguments and not _has_own_json(arguments)
    if as_json:
        arguments.remove(JSON)
    named = [word for argument in arguments for word in re.split(r"[=,\[\]{}\s]+", argument) if is_place(word)]
    allow_code(*named, *(["1"] if ALLOW in sys.argv else []))
    if named or ALLOW in sys.argv:
        # Robots, tasks and metrics of your own ("my_module:MyRobot") may be in the current folder. At the end of the
        # search path, files in it cannot replace modules of the suite.
        sys.path.append(os.getcwd())
    try:
        if as_json:
            _print_json(arguments)
        else:
            cli(arguments, prog_name="softgym", standalone_mode=False)
    except click.exceptions.Exit as leave:
        sys.exit(leave.exit_code)
    except (click.Abort, KeyboardInterrupt) as stop:
        hint = "; run the same command again to continue" if isinstance(stop, Resumable) else ""
        click.echo(f"stopped{hint}", err=True)
        sys.exit(130)
    except click.ClickException as error:
        _fail(error.format_message())
    except ImportError as error:
        line = str(error) if isinstance(error, SoftGymError) else explain(error)
        if line is None:
            raise
        _fail(line)
    except (SoftGymError, ValueError, OSError, gymnasium.error.Error) as error:
        if hasattr(error, "__notes__"):  # an error in a robot's code, annotated by `Robot.build`
            raise
        _fail(_described(error))


def _has_own_json(arguments: Sequence[str]) -> bool:
    """Return whether the verb of some arguments, or of a group in it, has an option `JSON`."""
    command: click.Command | None = cli
    context = click.Context(cli)
    for argument in arguments:
        if not isinstance(command, click.Group) or command.get_command(context, argument) is None:
            break
        command = command.get_command(context, argument)
    return command is not None and any(JSON in parameter.opts for parameter in command.params)


def _print_json(arguments: Sequence[str]) -> None:
    """Run a verb and print ``{"verb": ..., "result": ..., "lines": [...]}``: what it returns, and what it says."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        result = cli(list(arguments), prog_name="softgym", standalone_mode=False)
    document = {"verb": arguments[0] if arguments else None, "result": result, "lines": said.getvalue().splitlines()}
    click.echo(json.dumps(document, default=str))


def _described(error: Exception) -> str:
    """Return the message of an error; for an error of the file system, the file and the reason."""
    if not isinstance(error, OSError) or error.strerror is None:
        return str(error)
    if error.filename is None:
        return error.strerror
    if isinstance(error, FileExistsError | NotADirectoryError):
        return f"'{error.filename}' cannot be a folder: a file is in its way"
    return f"'{error.filename}': {error.strerror}"


def _fail(message: str) -> NoReturn:
    click.echo(f"softgym: error: {' '.join(message.split())}", err=True)
    sys.exit(2)
