"""Verbs for environments: list, rollout."""

from __future__ import annotations

import contextlib
import functools
import importlib
import json
import operator
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softgym_envs.cli import options
from softgym_envs.errors import ConfigError
from softgym_envs.registry import import_object
from softgym_envs.wording import counted

if TYPE_CHECKING:
    from softgym_envs.agents.config import EnvironmentConfig

AGENT_HELP = (
    "qp, qp_static, qp_model, qp_pi, qp_estimated, force, close, gait, steer, random, or a policy (a file, the folder "
    "of a training or the name of a shipped one); gait@POLICY and steer@POLICY have the gait of a policy."
)


def environment_of_agents(
    verb: str,
    agents: tuple[str, ...],
    backend: str | None,
    *,
    id: str | None = None,
    config: Path | None = None,
    robot: str | None = None,
    task: str | None = None,
    options_: tuple[str, ...] = (),
    task_options: tuple[str, ...] = (),
    weights: Path | None = None,
) -> EnvironmentConfig:
    """Return the environment that a command names for its agents, by default that of the first policy among them.

    A policy needs the same observations and actions as in training.

    Args:
        verb: for messages.
        agents: names, or files of policies.
        backend: its backend, if not the default.
        id: an ID, also ``module:ID`` as for Gymnasium: the module that registers it is imported.
        config: configuration of a training, in place of the ID.
        robot: a robot, in place of the ID.
        task: task of the robot.
        options_: options of the robot, ``name=value``.
        task_options: options of the task.
        weights: folder of surrogate weights.

    Raises:
        ConfigError: for an unknown agent, or if the command names several environments or none.
    """
    from softgym_envs.agents.baselines import BASELINES
    from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
    from softgym_envs.agents.evaluation import check_agent
    from softgym_envs.agents.policy import Policy
    from softgym_envs.config import check_config, load_config

    for agent in agents:
        check_agent(agent)
    policies = [Policy(agent) for agent in agents if agent not in BASELINES]
    data: dict[str, Any] = policies[0].environment.model_dump() if policies else {}
    given = {"ENVIRONMENT": id, "--config": config, "--robot": robot}
    named = [name for name, value in given.items() if value is not None]
    if len(named) > 1:
        raise ConfigError(f"{verb} takes one environment, got {' and '.join(named)}")
    if not named and not policies:
        raise ConfigError(
            f"{verb} needs an ENVIRONMENT (softgym list), --robot my_module:MyRobot, --config or a policy as --agent"
        )
    if task is not None and robot is None:
        raise ConfigError(f"--task {task} needs --robot: the ID of an environment has its own task")
    if config is not None:
        data = load_config(config, TrainConfig).environment.model_dump()
    elif id is not None:
        data |= {"id": _registered(id), "robot": None, "task": None}
    elif robot is not None:
        data |= {"id": None, "robot": robot, "task": task or data.get("task") or "reach"}
    for key, option, pairs in (("robot_options", "option", options_), ("task_options", "task-option", task_options)):
        if pairs:
            data[key] = {**data.get(key, {}), **options.values_of(option, pairs)}
    if weights is not None:
        data["backend_options"] = {**data.get("backend_options", {}), "weights": str(weights)}
    found = check_config(EnvironmentConfig, data, verb)
    for policy in policies:
        policy.check_environment(found)
    return found if backend is None else found.on(backend)


def _registered(id: str) -> str:
    """Return an ID; ``module:ID`` imports the module, which may be in the current folder."""
    module, colon, name = id.rpartition(":")
    if not colon:
        return id
    sys.path.append(os.getcwd())
    try:
        imported = importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ConfigError(f"environment '{id}': module '{module}' cannot be imported: {error}") from None
    if isinstance(getattr(imported, name, None), type):
        raise ConfigError(f"'{id}' is a class, not the ID of an environment; a robot is given as --robot {id}")
    return name


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
@click.argument("environment", required=False, shell_complete=options.complete_environment)
@options.environment
@click.option("--agent", default="qp", show_default=True, help=AGENT_HELP)
@click.option("--backend", help="surrogate, hybrid or fem (default: the environment's).")
@options.design
@click.option("--seed", default=0, show_default=True, help="Seed of the episode.")
@options.writers
def rollout(
    environment: str | None,
    agent: str,
    backend: str | None,
    design: tuple[str, ...],
    seed: int,
    **chosen: Any,
) -> dict[str, Any]:
    """Run one episode and print its result.

    ENVIRONMENT is an ID (softgym list), or module:ID as for Gymnasium. Without one, --robot, --config or the policy of
    --agent says which environment it is.
    """
    import softgym_envs  # noqa: F401 - registers the IDs
    from softgym_envs.agents.evaluation import make_agent
    from softgym_envs.surrogate.domain import distrust_text
    from softgym_envs.viewer.moment import WRITERS, watch_rollout

    written: dict[str, Path] = {name: path for name in WRITERS if (path := chosen.pop(name)) is not None}
    for name, path in written.items():
        if (suffixes := WRITERS[name].suffixes) and path.suffix not in suffixes:
            allowed = " or ".join(", ".join(suffixes).rsplit(", ", 1))
            raise ConfigError(f"file of --{name} '{path}' must end with {allowed}")
    body = options.design_of(design)
    config = environment_of_agents("rollout", (agent,), backend, id=environment, **chosen)
    act = make_agent(agent, seed)
    drawn = {"render_mode": "rgb_array"} if any(WRITERS[name].draws for name in written) else {}
    env = config.make(**({"design": body} if body else {}), **drawn)
    with contextlib.ExitStack() as open_files:
        makers = {name: import_object("writer of episodes", WRITERS[name].place) for name in written}
        watchers = [open_files.enter_context(makers[name](env.unwrapped, path)) for name, path in written.items()]
        summary = watch_rollout(env, act, watchers, seed=seed)
    total, step, distrust_codes = summary["return"], summary["steps"], summary["distrust_codes"]
    info = {"distance": summary["final_distance"], "is_success": summary["success"]}
    click.echo(f"{config.title} on {config.backend}, agent {agent}: {counted(step, 'step')}, return {total:.2f}")
    scale = config.task_class.distance_scale
    click.echo(f"final {scale.name} {scale.text(info['distance'], 3)}, success {info['is_success']}")
    if distrusted := [distrust for distrust in distrust_codes if distrust]:
        reasons = distrust_text(functools.reduce(operator.or_, distrusted))
        verb = "is" if len(distrusted) == 1 else "are"
        count = f"{len(distrusted)} of {len(distrust_codes)} states"
        click.echo(f"{count} {verb} not trusted: {reasons}; compare with --backend fem")
    for name, path in written.items():
        hint = WRITERS[name].hint.format(path=path)
        click.echo(f"wrote {path}{hint and '; '}{hint}")
    env.close()
    return {**summary, "backend": config.backend, "seed": seed}
