"""Verbs for environments: list, rollout, record, view."""

from __future__ import annotations

import contextlib
import functools
import json
import operator
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softgym_envs.cli import options
from softgym_envs.errors import ConfigError
from softgym_envs.extras import require
from softgym_envs.wording import counted

if TYPE_CHECKING:
    from softgym_envs.agents.config import EnvironmentConfig

AGENT_HELP = (
    "qp, qp_static, qp_model, qp_pi, qp_estimated, force, close, random, or a policy (a file, or the name of a shipped "
    "one)."
)


def environment_of_agent(id: str, agent: str, backend: str | None, verb: str) -> EnvironmentConfig:
    """Return the environment for an agent: a policy needs the same observations and actions as in training."""
    from softgym_envs.agents.baselines import BASELINES
    from softgym_envs.agents.config import EnvironmentConfig
    from softgym_envs.agents.policy import Policy
    from softgym_envs.config import check_config

    policy = None if agent in BASELINES else Policy(agent)
    trained = {} if policy is None else policy.environment.model_dump()
    config = check_config(EnvironmentConfig, {**trained, "id": id}, verb)
    if policy is not None:
        policy.check_environment(config)
    return config if backend is None else config.on(backend)


@click.command("list")
@options.as_json
def list_(as_json: bool) -> None:
    """List environments, robots, backends and tasks."""
    from softgym_envs.backends.registry import BACKENDS
    from softgym_envs.envs.registration import ENVIRONMENTS
    from softgym_envs.envs.tasks.registry import TASKS
    from softgym_envs.robots.registry import ROBOTS

    tables = {"robots": ROBOTS, "backends": BACKENDS, "tasks": TASKS}
    if as_json:
        columns = ("robot", "task", "max_episode_steps", "backend")
        rows = {name: {key: getattr(row, key) for key in columns} for name, row in ENVIRONMENTS.items()}
        click.echo(json.dumps({"environments": rows, **{title: list(table) for title, table in tables.items()}}))
        return
    click.echo("environments:")
    width = max(map(len, ENVIRONMENTS))
    for identifier, row in ENVIRONMENTS.items():
        backend = f", backend {row.backend}" if row.backend else ""
        steps = counted(row.max_episode_steps, "step")
        click.echo(f"  {identifier:{width}s}  robot {row.robot}, task {row.task}, {steps}{backend}")
    for title, table in tables.items():
        click.echo(f"{title}: {', '.join(table)}")


@click.command()
@click.argument("environment", shell_complete=options.complete_environment)
@click.option("--agent", default="qp", show_default=True, help=AGENT_HELP)
@click.option("--backend", help="surrogate, hybrid or fem (default: the environment's).")
@options.design
@click.option("--seed", default=0, show_default=True, help="Seed of the episode.")
@click.option("--record", type=options.PATH, help="Write a rerun recording (.rrd) to this file.")
@click.option("--video", type=options.PATH, help="Write a film (.mp4, .gif or .webp) to this file.")
@click.option("--paraview", type=options.PATH, help="Write a time series for ParaView to this folder.")
@click.option("--glb", type=options.PATH, help="Write an animation for Blender and browsers (.glb) to this file.")
def rollout(
    environment: str,
    agent: str,
    backend: str | None,
    design: tuple[str, ...],
    seed: int,
    record: Path | None,
    video: Path | None,
    paraview: Path | None,
    glb: Path | None,
) -> None:
    """Run one episode and print its result."""
    import softgym_envs  # noqa: F401 - registers the IDs
    from softgym_envs.agents.evaluation import check_agent, make_agent
    from softgym_envs.surrogate.domain import distrust_text
    from softgym_envs.viewer.gltf import GlbWriter
    from softgym_envs.viewer.paraview import ParaviewWriter
    from softgym_envs.viewer.recording import Filmed, Watcher, recorder_of, watch_rollout

    if record is not None and record.suffix != ".rrd":
        raise ConfigError(f"recording '{record}' must end with .rrd; --video writes films")
    if glb is not None and glb.suffix != ".glb":
        raise ConfigError(f"animation '{glb}' must end with .glb")
    if video is not None:
        from softgym_envs.viewer.video import check_video, write_video

        check_video(video)  # before the work begins
    chosen = options.design_of(design)
    check_agent(agent)
    config = environment_of_agent(environment, agent, backend, "rollout")
    act = make_agent(agent, seed)
    drawn = {"render_mode": "rgb_array"} if video is not None else {}
    env = config.make(**({"design": chosen} if chosen else {}), **drawn)
    frames: list[Any] = []
    with contextlib.ExitStack() as open_files:
        watchers: list[Watcher] = []
        if record is not None:
            watchers.append(open_files.enter_context(recorder_of(env, record)))
        robot = env.unwrapped.robot  # type: ignore[attr-defined]
        if paraview is not None:
            watchers.append(open_files.enter_context(ParaviewWriter(robot, paraview)))
        if glb is not None:
            watchers.append(open_files.enter_context(GlbWriter(robot, glb)))
        if video is not None:
            watchers.append(Filmed(env, frames))
        summary = watch_rollout(env, act, watchers, seed=seed)
    total, step, distrust_codes = summary["return"], summary["steps"], summary["distrust_codes"]
    info = {"distance": summary["final_distance"], "is_success": summary["success"]}
    click.echo(f"{environment} on {config.backend}, agent {agent}: {counted(step, 'step')}, return {total:.2f}")
    scale = config.task_class.distance_scale
    click.echo(f"final {scale.name} {scale.text(info['distance'], 3)}, success {info['is_success']}")
    if distrusted := [distrust for distrust in distrust_codes if distrust]:
        reasons = distrust_text(functools.reduce(operator.or_, distrusted))
        verb = "is" if len(distrusted) == 1 else "are"
        count = f"{len(distrusted)} of {len(distrust_codes)} states"
        click.echo(f"{count} {verb} not trusted: {reasons}; compare with --backend fem")
    if video is not None:
        write_video(video, frames, fps=env.metadata["render_fps"])
        click.echo(f"wrote {video}")
    if record is not None:
        click.echo(f"wrote {record}; open it with 'softgym view {record}'")
    if paraview is not None:
        click.echo(f"wrote {paraview}; open its .pvd files with ParaView")
    if glb is not None:
        click.echo(f"wrote {glb}")
    env.close()


@click.command()
@click.argument("environment")
@click.argument("name")
@click.option("--agent", default="qp", show_default=True, help=AGENT_HELP)
@click.option("--backend", help="surrogate, hybrid or fem (default: the environment's).")
@options.design
@click.option("--episodes", default=100, show_default=True, help="Number of episodes.")
@click.option("--seed", default=0, show_default=True, help="Seed of the first episode; the next ones add 1 each.")
def record(
    environment: str,
    name: str,
    agent: str,
    backend: str | None,
    design: tuple[str, ...],
    episodes: int,
    seed: int,
) -> None:
    """Record episodes as a Minari dataset, for offline learning.

    NAME is the name of the dataset, such as softgym/finger-reach/qp-v0.
    """
    import softgym_envs  # noqa: F401 - registers the IDs
    from softgym_envs.agents.evaluation import check_agent
    from softgym_envs.agents.offline import record_episodes

    if episodes < 1:
        raise ConfigError(f"--episodes {episodes} must be at least 1")
    check_agent(agent)
    config = environment_of_agent(environment, agent, backend, "record")
    chosen = options.design_of(design) or None
    dataset = record_episodes(name, agent, config, episodes=episodes, design=chosen, seed=seed)
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
