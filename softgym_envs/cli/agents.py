"""Verbs for agents: train, evaluate."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softgym_envs.cli import options
from softgym_envs.cli.environments import AGENT_HELP, environment_of_agents
from softgym_envs.errors import ConfigError
from softgym_envs.wording import counted

if TYPE_CHECKING:
    import numpy as np

    from softgym_envs.agents.evaluation import Bodies


@click.command()
@options.run_options("agents")
@options.folder
@click.option("--initial", type=options.PATH, help="Policy to start from: a file, or the folder of a training.")
def train(config: Path, folder: Path, initial: Path | None, quiet: bool, overrides: tuple[str, ...]) -> dict[str, str]:
    """Train a policy with the learner that the configuration names.

    An interrupted run continues from its last checkpoint. In the same folder, more steps (steps=80000) extend a
    finished run, and fewer shorten one that has not ended.
    """
    from softgym_envs.agents.config import TrainConfig
    from softgym_envs.agents.training import is_finished
    from softgym_envs.agents.training import train as run
    from softgym_envs.config import load_config

    wanted = load_config(config, TrainConfig, overrides)
    finished = is_finished(folder, wanted.steps)
    with options.resumable():
        path = run(wanted, folder, initial=initial, progress=not quiet, keep_checkpoint=True)
    if finished:
        click.echo(f"{path} is finished after {wanted.steps} steps; a larger steps=... trains on")
    else:
        click.echo(f"wrote {path}")
    return {"policy": str(path)}


@click.command()
@click.option("--environment", help="An ID, in place of --config.", shell_complete=options.complete_environment)
@options.environment
@click.option(
    "--agent", "agents", multiple=True, default=("qp", "random"), show_default=True, help=AGENT_HELP + " Repeatable."
)
@click.option(
    "--backend", "backends", multiple=True, help="surrogate, hybrid or fem (default: the environment's). Repeatable."
)
@options.design
@click.option("--goals", default=200, show_default=True, help="Number of unseen goals.")
@click.option("--seed", default=2_000_003, show_default=True, help="Seed of the goals.")
@click.option(
    "--workers", default=1, show_default=True, help="Number of processes for goals that run one by one, as on FEM."
)
@click.option("--output", type=options.PATH, help="Write all results as JSON to this file.")
@options.as_json
@options.overrides
def evaluate(
    environment: str | None,
    agents: tuple[str, ...],
    backends: tuple[str, ...],
    design: tuple[str, ...],
    goals: int,
    seed: int,
    workers: int,
    output: Path | None,
    as_json: bool,
    overrides: tuple[str, ...],
    **given: Any,
) -> None:
    """Evaluate agents on the same unseen goals.

    --config is the one that the policies were trained with, and KEY=VALUE changes it; --environment or --robot name
    another environment. Without any of them it is that of the first policy. If it draws bodies (sample_design), each
    goal has a drawn body of its own, as in training, and the environment's own body is evaluated next; --design
    replaces both.
    """
    from softgym_envs.agents.baselines import BASELINES
    from softgym_envs.agents.config import TrainConfig
    from softgym_envs.agents.evaluation import check_agent, evaluation_set, sample_goals
    from softgym_envs.agents.evaluation import evaluate as run
    from softgym_envs.agents.policy import Policy
    from softgym_envs.config import load_config
    from softgym_envs.runs import provenance
    from softgym_envs.storage import write_json

    config, others = given["config"], {**given, "config": None, "id": environment}
    if config is not None and not any(others.values()):
        wanted = load_config(config, TrainConfig, overrides).environment
    elif overrides and "=" not in overrides[0]:
        how = "an environment is named by --environment, a robot by --robot"
        raise ConfigError(f"'{overrides[0]}' is not KEY=VALUE; {how}")
    elif overrides:
        raise ConfigError(f"'{overrides[0]}' changes a configuration: it needs --config, and no other environment")
    else:
        wanted = environment_of_agents("evaluate", agents, None, id=environment, **given)
    chosen = options.design_of(design) or None
    if goals < 1:
        raise ConfigError(f"--goals {goals} must be at least 1")
    if workers < 1:
        raise ConfigError(f"--workers {workers} must be at least 1")
    if output is not None:  # before the work begins
        if output.is_dir():
            raise ConfigError(f"--output '{output}' is a folder; name a file")
        output.parent.mkdir(parents=True, exist_ok=True)
    for agent in agents:  # reject an invalid policy before any evaluation
        check_agent(agent)
        if agent not in BASELINES:
            Policy(agent).check_environment(wanted)
    single = sample_goals(wanted.model_copy(update={"sample_design": False}), goals, seed, chosen)
    # What the results are of: its name and its heading, the bodies and their goals.
    parts: list[tuple[str, str, Bodies, np.ndarray]] = [("one", "", chosen, single)]
    drawn = None
    if wanted.sample_design and chosen is None:
        drawn, points = evaluation_set(wanted, goals, seed)
        heading = f"{counted(goals, 'drawn body')}, one for each goal (seed {seed}):"
        parts = [("drawn", heading, drawn, points), ("own", "the environment's own body:", None, single)]
    shown = wanted.task_class.distance_scale.text
    results: list[dict[str, Any]] = []
    say = partial(click.echo, err=as_json)  # stdout is for the JSON
    say(f"{'agent':34s} {'backend':10s} {'success':>8s} {'mean':>11s} {'worst':>11s} {'return':>8s}")
    for bodies, heading, designs, points in parts:
        if heading:
            say(heading)
        for backend in backends or (wanted.backend,):
            for agent in agents:
                outcome = run(agent, wanted.on(backend), points, design=designs, seed=seed, workers=workers)
                results.append({"agent": agent, "backend": backend, "bodies": bodies, **outcome.to_json()})
                distances = (f"{shown(value, 3):>11s}" for value in (outcome.mean_distance, outcome.worst_distance))
                rate, total = f"{outcome.success_rate:8.1%}", f"{outcome.mean_return:8.2f}"
                say(f"{agent[-34:]:34s} {backend:10s} {rate} {' '.join(distances)} {total}")
    inputs = {"environment": wanted.model_dump(mode="json"), "goals": goals, "seed": seed, "design": chosen}
    document = {**inputs, "drawn_designs": drawn and [dict(body) for body in drawn], **provenance(), "results": results}
    if as_json:
        click.echo(json.dumps(document))
    if output is not None:
        write_json(output, document)
        say(f"wrote {output}")
