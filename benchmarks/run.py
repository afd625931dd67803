"""``softgym bench`` (or ``make bench``): run benchmarks, print their results and record them in one JSON file."""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from benchmarks import (
    accuracy,
    accurate_meshes,
    beams,
    carry,
    codesign_scale,
    contact,
    contact_control,
    contact_friction,
    convergence,
    deployed_estimator,
    deployed_loop,
    design_networks,
    design_tools,
    dynamics,
    estimation,
    export,
    extension,
    force_limits,
    gpu,
    hybrid,
    learned_sensors,
    learners,
    modular,
    morphing,
    motion,
    networks,
    point_meshes,
    printed,
    robot_dynamics,
    robots,
    robustness,
    sensor_accuracy,
    sensor_finger,
    sensor_fronts,
    side_by_side,
    speed,
    strategies,
    trust,
    validation,
)
from softgym_envs.config import provenance
from softgym_envs.errors import ConfigError, unknown_name
from softgym_envs.storage import write_json

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "benchmarks" / "results.json"
"""Recorded results: each of a commit that anyone can run again."""

BENCHMARKS: dict[str, Callable[[], dict[str, object]]] = {
    "fem_step": speed.fem_step,
    "fem_profile": speed.fem_profile,
    "fem_speed": speed.fem_speed,
    "beams": beams.beams,
    "notched_beam": speed.notched_beam,
    "surrogate_step": speed.surrogate_step,
    "gpu_step": gpu.gpu_step,
    "inference": speed.inference,
    "memory": speed.memory,
    "motion": motion.motion,
    "printed": printed.printed,
    "test_set": accuracy.test_set,
    "trajectories": accuracy.trajectories,
    "slack": accuracy.slack_states,
    "mesh_motion": accuracy.mesh_motion,
    "point_meshes": point_meshes.point_meshes,
    "positive_definite": accuracy.positive_definite,
    "design_gradients": accuracy.design_gradients,
    "networks": networks.networks,
    "design_networks": design_networks.design_networks,
    "morphing": morphing.morphing,
    "hybrid": hybrid.hybrid,
    "deployed": export.deployed,
    "deployed_estimator": deployed_estimator.deployed_estimator,
    "deployed_loop": deployed_loop.deployed_loop,
    "tracking": robots.tracking,
    "closed_loop": robots.closed_loop,
    "predicted_tracking": robots.predicted_tracking,
    "shared_finger": robots.shared_finger,
    "stiff_flop": robots.stiff_flop,
    "carry": carry.carry,
    "contact_control": contact_control.contact_control,
    "contact_friction": contact_friction.contact_friction,
    "sensor_finger": sensor_finger.published,
    "sensor_accuracy": sensor_accuracy.sensor_accuracy,
    "estimation": estimation.accuracy,
    "sealed_finger": estimation.sealed_finger,
    "force_limits": force_limits.force_limits,
    "design_optima": design_tools.optima,
    "calibration": design_tools.calibration,
    "sensor_front": sensor_fronts.sensor_front,
    "sensor_front_published": sensor_fronts.sensor_front_published,
    "sensor_pressure_front": sensor_fronts.sensor_pressure_front,
    "sensor_four_cavities_front": sensor_fronts.sensor_four_cavities_front,
    "sensor_information_front": sensor_fronts.sensor_information_front,
    "validation": validation.validation,
    "side_by_side": side_by_side.side_by_side,
    "contact": contact.contact,
    "dynamics": dynamics.dynamics,
    "tetrapod": robot_dynamics.tetrapod,
    "learned_sensors": learned_sensors.learned_sensors,
    "learned_sensors_4cavities": learned_sensors.learned_sensors_4cavities,
    "learners": learners.learners,
    "extension": extension.extension,
    "strategies": strategies.strategies,
    "codesign_kills": codesign_scale.kills,
    "codesign_profile": codesign_scale.profile,
    **accurate_meshes.BENCHMARKS,
    **convergence.BENCHMARKS,
    **modular.BENCHMARKS,
    **robustness.BENCHMARKS,
    **trust.BENCHMARKS,
}
"""Registry of benchmarks."""


def run(names: Sequence[str], output: str | Path) -> dict[str, dict[str, object]]:
    """Run the named benchmarks (default: all) and write each result with its provenance to a JSON file.

    The file keeps its results of other benchmarks, with the commit that made them. A name also stands for all
    benchmarks that begin with it and an underscore: ``convergence`` for those of every robot. Ctrl-C prints the command
    that runs those which are not finished.

    Raises:
        ConfigError: for an unknown name, or a file with other contents.
    """
    chosen = list(dict.fromkeys(full for name in names for full in matching(name))) or list(BENCHMARKS)
    kept = _read(Path(output))
    origin = _origin(Path(output))
    results: dict[str, dict[str, object]] = {}
    for name in chosen:
        click.echo(f"\n{name}: {(BENCHMARKS[name].__doc__ or '').splitlines()[0]}")
        try:
            results[name] = BENCHMARKS[name]()
        except KeyboardInterrupt:
            rest = shlex.join(["softgym", "bench", "--output", str(output), *chosen[len(results) :]])
            click.echo(f"\n{len(results)} of {len(chosen)} benchmarks finished; to go on: {rest}", err=True)
            raise
        for key, value in results[name].items():
            click.echo(f"  {key:58s} {value:.6g}" if isinstance(value, float) else f"  {key:58s} {value}")
        machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
        kept[name] = {"results": results[name], "machine": machine, **origin, "time": provenance()["time"]}
        write_json(output, kept)
    click.echo(f"\nwrote {output}")
    return results


def matching(name: str) -> list[str]:
    """Return the benchmarks that a name stands for."""
    found = [full for full in BENCHMARKS if full == name or full.startswith(f"{name}_")]
    if not found:
        raise ConfigError(unknown_name("benchmark", name, BENCHMARKS))
    return [name] if name in BENCHMARKS else found


def _origin(output: Path) -> dict[str, Any]:
    """Return the origin of results before any are written; earlier ones in the records do not count as changes."""
    origin = provenance()
    if output.resolve() == RECORDS:
        command = ["git", "-C", str(ROOT), "status", "--porcelain", "--untracked-files=no", "--", "."]
        command.append(f":!{RECORDS.relative_to(ROOT)}")
        changed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\n")
        if changed != [""]:
            raise ConfigError(
                f"'{RECORDS.name}' holds results of committed code only, but {changed[0][3:]} is changed; "
                "commit first, or name another --output"
            )
        origin["commit"] = origin["commit"].removesuffix("-dirty")
    return origin


def _read(path: Path) -> dict[str, Any]:
    """Results of earlier runs, by benchmark."""
    if not path.exists():
        return {}
    try:
        kept = json.loads(path.read_text())
    except ValueError:
        kept = None
    if not isinstance(kept, dict) or not all(isinstance(e, dict) and "results" in e for e in kept.values()):
        raise ConfigError(f"'{path}' does not hold results of benchmarks; name another --output")
    return kept
