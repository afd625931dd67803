"""Entry point of the command line: its verbs, and errors reported as one line with status 2."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

import click

from softgym_envs.cli import agents, bench, benchmark, codesign, configs, doctor, environments, robots, surrogates
from softgym_envs.cli.options import Resumable, Verbs
from softgym_envs.errors import SoftGymError
from softgym_envs.extras import explain
from softgym_envs.version import __version__

SECTIONS = {
    "Environments": (environments.list_, environments.rollout, environments.record, environments.view),
    "Robots": (robots.show, robots.export),
    "Surrogates": (
        surrogates.dataset,
        surrogates.fit,
        surrogates.fit_inertia,
        surrogates.calibrate_trust,
        surrogates.deploy,
    ),
    "Agents": (agents.train, agents.evaluate, agents.results, agents.deploy_policy),
    "Design and control": (codesign.codesign, codesign.optimise, codesign.sensitivity, codesign.calibrate),
    "Benchmark": (benchmark.benchmark,),
    "Configurations": (configs.configs,),
    "Development": (doctor.doctor, bench.bench),
}


class _Verbs(Verbs):
    """The group of all verbs, whose help lists them by section."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, self.commands))  # all sections share the same two columns
        for title, verbs in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(f"{verb.name:{width}}", verb.get_short_help_str(80)) for verb in verbs])


@click.group(
    cls=_Verbs,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(__version__, prog_name="softgym")
@click.pass_context
def cli(ctx: click.Context) -> None:
    """Optimise the body and the controller of a soft robot together."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


for _verbs in SECTIONS.values():
    for _verb in _verbs:
        cli.add_command(_verb)


def main() -> None:
    """Run the command line; an error in the user's input ends it with one line and status 2."""
    import gymnasium
    from threadpoolctl import threadpool_limits

    # One thread per process: more threads slow down these small problems. The variables affect libraries loaded later
    # and worker processes; the limit affects libraries that are already loaded.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    threadpool_limits(1)
    # Robots, tasks and objectives of your own ("my_module:MyRobot") may be in the current folder. At the end of the
    # search path, files in it cannot replace modules of the suite.
    sys.path.append(os.getcwd())
    try:
        cli(prog_name="softgym", standalone_mode=False)
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
