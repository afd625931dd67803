"""Verbs: record, view."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click

from softgym_envs.cli import options
from softgym_envs.cli.environments import AGENT_HELP, environment_of_agents
from softgym_envs.errors import ConfigError
from softgym_envs.extras import require
from softgym_envs.wording import counted


@click.command()
@click.argument("names", nargs=-1, metavar="[ENVIRONMENT] NAME")
@options.environment
@click.option("--agent", default="qp", show_default=True, help=AGENT_HELP)
@click.option("--backend", help="surrogate, hybrid or fem (default: the environment's).")
@options.design
@click.option("--episodes", default=100, show_default=True, help="Number of episodes.")
@click.option("--seed", default=0, show_default=True, help="Seed of the first episode; the next ones add 1 each.")
def record(
    names: tuple[str, ...],
    agent: str,
    backend: str | None,
    design: tuple[str, ...],
    episodes: int,
    seed: int,
    **chosen: Any,
) -> None:
    """Record episodes as a Minari dataset, for offline learning.

    NAME is the name of the dataset, such as softgym/finger-reach/qp-v0. ENVIRONMENT as for rollout.
    """
    import softgym_envs  # noqa: F401 - registers the IDs
    from softgym_envs.extensions.recordings.minari_dataset import record_episodes

    if episodes < 1:
        raise ConfigError(f"--episodes {episodes} must be at least 1")
    if not 1 <= len(names) <= 2:
        raise ConfigError(f"record takes [ENVIRONMENT] NAME, got {' '.join(names) or 'nothing'}")
    id, name = names if len(names) == 2 else (None, names[0])
    config = environment_of_agents("record", (agent,), backend, id=id, **chosen)
    body = options.design_of(design) or None
    dataset = record_episodes(name, agent, config, episodes=episodes, design=body, seed=seed)
    episodes_text, steps_text = counted(dataset.total_episodes, "episode"), counted(dataset.total_steps, "step")
    click.echo(f"wrote {episodes_text}, {steps_text}: minari.load_dataset('{name}')")


@click.command()
@click.argument("recording", type=options.PATH)
def view(recording: Path) -> None:
    """Open a recording in the rerun viewer.

    'softgym rollout ENVIRONMENT --record FILE' makes a recording.
    """
    import subprocess

    if not recording.is_file():
        raise ConfigError(f"recording '{recording}' does not exist; make one with 'softgym rollout ... --record'")
    require("viewer")
    if not any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        raise ConfigError(f"there is no display to open '{recording}' on; copy the file to a machine that has one")
    sys.exit(subprocess.call([sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(recording)]))
