"""The verb hardware: benches are examined, driven and emulated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from softgym_envs.cli import options
from softgym_envs.cli.environments import AGENT_HELP, environment_of_agents
from softgym_envs.extras import require

if TYPE_CHECKING:
    from softgym_envs.extensions.hardware.bench import Bench, BenchConfig

BENCH = click.argument("bench", type=options.PATH)
EMULATE = click.option(
    "--emulate", is_flag=True, help="Drive an emulation of the bench, in simulated time, in place of its ports."
)


@click.group(cls=options.Verbs)
def hardware() -> None:
    """Drive a physical robot: BENCH is a YAML file that names its ports and drives."""


def _load(bench: Path, overrides: tuple[str, ...]) -> BenchConfig:
    from softgym_envs.config import load_config
    from softgym_envs.extensions.hardware.bench import BenchConfig

    return load_config(bench, BenchConfig, overrides)


def _open(config: BenchConfig, emulate: bool) -> Bench:
    """Return a bench with its own ports, or an emulation of it."""
    if emulate:
        from softgym_envs.extensions.hardware.simulated_time import emulated_bench

        return emulated_bench(config)
    from softgym_envs.extensions.hardware.bench import Bench

    require("hardware")
    return Bench.open(config)


@hardware.command()
@BENCH
@EMULATE
@options.as_json
@options.overrides
def check(bench: Path, emulate: bool, as_json: bool, overrides: tuple[str, ...]) -> None:
    """Find all drives and say what they and the tracker measure. Nothing gets power or moves."""
    with _open(_load(bench, overrides), emulate) as found:
        reading = found.device.connect()
        found.clock.wait(found.clock.now() + 0.2)
        seen = None if found.tracker is None else found.tracker()
        values: list[Any] = [found.robot.actuators, reading.displacement.tolist(), reading.effort.tolist()]
        if as_json:
            rows = {
                actuator.name: {"displacement": _known(displacement), "effort": _known(effort)}
                for actuator, displacement, effort in zip(*values, strict=True)
            }
            click.echo(json.dumps({"actuators": rows, "effectors": None if seen is None else seen.tolist()}))
            return
        for actuator, displacement, effort in zip(*values, strict=True):
            parts = [f"{displacement:g} {actuator.unit}" if np.isfinite(displacement) else "displacement not measured"]
            parts.append(f"effort {effort:g}" if np.isfinite(effort) else "effort not measured")
            click.echo(f"{actuator.name}: {', '.join(parts)}")
        where = "no tracker" if found.tracker is None else "not seen" if seen is None else f"{seen.tolist()} m"
        click.echo(f"effectors: {where}")


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


@hardware.command()
@BENCH
@click.argument("environment", shell_complete=options.complete_environment)
@click.option("--agent", default="qp_pi", show_default=True, help=AGENT_HELP)
@click.option("--episodes", default=1, show_default=True, help="Number of episodes.")
@click.option("--seed", default=0, show_default=True, help="Seed of the first episode; the next ones add 1 each.")
@click.option("--log", type=options.PATH, help="CSV file of what was done and seen, for softgym calibrate.")
@click.option("--trial", default="1", show_default=True, help="Name of this session in the log.")
@EMULATE
@options.as_json
@options.overrides
def run(
    bench: Path,
    environment: str,
    agent: str,
    episodes: int,
    seed: int,
    log: Path | None,
    trial: str,
    emulate: bool,
    as_json: bool,
    overrides: tuple[str, ...],
) -> None:
    """Drive the robot through episodes of an environment, in real time.

    ENVIRONMENT is an ID; SoftGym/Reach-v0 and SoftGym/Track-v0 take the robot of the bench. The robot first goes home
    slowly, and again after each episode. Ctrl-C, a fault or a silent device takes the power from all drives.
    """
    from softgym_envs.agents.evaluation import check_agent, make_agent
    from softgym_envs.envs.registration import GENERIC_ENVIRONMENTS
    from softgym_envs.extensions.hardware.backend import HardwareBackend

    check_agent(agent)
    config = _load(bench, overrides)
    if environment in GENERIC_ENVIRONMENTS:
        given = tuple(f"{name}={json.dumps(value)}" for name, value in config.robot_options.items())
        named: dict[str, Any] = {"robot": config.robot, "options_": given}
        named["task"] = GENERIC_ENVIRONMENTS[environment].task
    else:
        named = {"id": environment}
    wanted, act = environment_of_agents("hardware run", (agent,), "hardware", **named), make_agent(agent, seed)
    scale, results = wanted.task_class.distance_scale, []
    with _open(config, emulate) as found:
        on_bench: dict[str, Any] = {"bench": found, "log": None if log is None else str(log), "trial": trial}
        env = wanted.make(backend_options=on_bench, design=config.design or None)
        body: Any = env.unwrapped
        backend: HardwareBackend = body.backend
        try:
            for k in range(episodes):
                observation, info = env.reset(seed=seed + k)
                act(observation, body)  # compiles what the first step needs, while nothing moves
                over = False
                while not over:
                    observation, _, terminated, truncated, info = env.step(act(observation, body))
                    over = terminated or truncated
                results.append({"distance": float(info["distance"]), "success": bool(info["is_success"])})
                if not as_json:
                    click.echo(f"episode {k + 1}: {scale.name} {scale.text(info['distance'], 3)}")
            backend.reset()
        finally:
            backend.close()
        if as_json:
            click.echo(json.dumps({"episodes": results, **backend.timing.to_json()}))
        else:
            click.echo(backend.timing.text())
            if log is not None:
                click.echo(f"wrote {log}; identify the drives with softgym calibrate")


@hardware.command()
@BENCH
@click.option("--backend", default="surrogate", show_default=True, help="Physics of the body: surrogate or fem.")
@click.option("--plant", multiple=True, metavar="NAME=VALUE", help="Difference from the model: gain, backlash, ...")
@click.option("--lost", default=0.0, show_default=True, help="Share of messages that get lost.")
@click.option("--latency", default=0.0, show_default=True, help="Age of positions that the tracker sends [s].")
@options.overrides
def emulate(
    bench: Path, backend: str, plant: tuple[str, ...], lost: float, latency: float, overrides: tuple[str, ...]
) -> None:
    """Serve an emulation of the bench on pseudo-terminals until Ctrl-C, for a program of yours."""
    from softgym_envs.extensions.hardware.serving import serve

    config = _load(bench, overrides)

    def ready(port: str, tracker: str) -> None:
        click.echo(f"{config.device}.port={port}")
        if config.tracker is not None:
            click.echo(f"tracker.port={tracker}")

    serve(config, ready, backend=backend, plant=options.design_of(plant), losses={"lost": lost}, latency=latency)
