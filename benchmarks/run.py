"""``softgym bench`` (or ``make bench``): measure speed, print the results and record them in one JSON file."""

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

from benchmarks import beams, gpu, parts, speed
from softgym_envs.errors import ConfigError, unknown_name
from softgym_envs.runs import provenance
from softgym_envs.storage import write_json

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "benchmarks" / "results.json"
"""Recorded results: each of a commit that anyone can run again."""

BENCHMARKS: dict[str, Callable[[], dict[str, object]]] = {
    "fem_step": speed.fem_step,
    "fem_profile": speed.fem_profile,
    "fem_speed": speed.fem_speed,
    "beams": beams.beams,
    "walking": beams.walking,
    "learned_tetrapod": parts.learned_tetrapod,
    "notched_beam": speed.notched_beam,
    "surrogate_step": speed.surrogate_step,
    "gpu_step": gpu.gpu_step,
    "inference": speed.inference,
    "memory": speed.memory,
}
"""Registry of benchmarks."""


def run(names: Sequence[str], output: str | Path) -> dict[str, dict[str, object]]:
    """Run the named benchmarks (default: all) and write each result with its provenance to a JSON file.

    The file keeps its results of other benchmarks, with the commit that made them. Ctrl-C prints the
    command that runs those which are not finished.

    Raises:
        ConfigError: for an unknown name, or a file with other contents.
    """
    if unknown := [name for name in names if name not in BENCHMARKS]:
        raise ConfigError(unknown_name("benchmark", unknown[0], BENCHMARKS))
    chosen = list(dict.fromkeys(names)) or list(BENCHMARKS)
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
