"""Verb that describes the installation: what a bug report needs."""

from __future__ import annotations

import json
import os
import platform
import shutil
import sys
from importlib import metadata
from pathlib import Path

import click

from softgym_envs import extras
from softgym_envs.cli import options
from softgym_envs.storage import cache_directory
from softgym_envs.version import __version__

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
LIBRARIES = ("gymnasium", "numpy", "scipy", "numba", "proxsuite", "daqp", "cvxopt", "ipctk", "meshio")


@click.command()
@options.as_json
def doctor(as_json: bool) -> None:
    """Describe this installation: versions, extras, caches, threads and devices."""
    report = examine()
    if as_json:
        click.echo(json.dumps(report))
        return
    for title, rows in report.items():
        click.echo(f"{title}:")
        width = max(map(len, rows))
        for name, value in rows.items():
            click.echo(f"  {name:{width}}  {value}")


def examine() -> dict[str, dict[str, str]]:
    """Return what describes this installation, by section; a fault is told in its row and raises nothing."""
    return {
        "installation": {
            "softgym-envs": f"{__version__} in {Path(extras.__file__).parent}",
            "python": f"{platform.python_version()} ({sys.executable})",
            "system": platform.platform(),
            **{name: _version(name) for name in LIBRARIES},
        },
        "extras": {name: _extra(modules) for name, modules in extras.EXTRAS.items()},
        "machine": {
            "processors": f"{_processors()} of {os.cpu_count()}",
            **{name: os.environ.get(name, "not set") for name in THREADS},
            "GPU": _gpu(),
        },
        "folders": {
            "cache": _folder(cache_directory("meshes").parent),
            "numba cache": _folder(Path(os.environ.get("NUMBA_CACHE_DIR") or Path(extras.__file__).parent)),
            "temporary": _folder(Path(os.environ.get("TMPDIR", "/tmp"))),
        },
        "libraries of the system": {"gmsh": _loads("gmsh"), "vtk": _loads("vtkmodules.vtkRenderingCore")},
    }


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"


def _extra(modules: tuple[str, ...]) -> str:
    missing = [module for module in modules if not extras.installed(module)]
    return f"missing {', '.join(missing)}" if missing else "installed"


def _processors() -> int:
    """Return the number of processors that this process may use, which a container may limit."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gpu() -> str:
    if not extras.installed("torch"):
        return "torch is not installed"
    import torch

    if not torch.cuda.is_available():
        return f"none used by torch {torch.__version__}"
    return f"{torch.cuda.get_device_name()} (torch {torch.__version__})"


def _folder(path: Path) -> str:
    """Return a folder with its free space, or what is wrong with it."""
    existing = next(parent for parent in (path, *path.parents) if parent.exists())
    if not os.access(existing, os.W_OK):
        return f"{path}: not writable"
    return f"{path} ({shutil.disk_usage(existing).free / 1e9:.1f} GB free)"


def _loads(module: str) -> str:
    if not extras.installed(module.partition(".")[0]):
        return "not installed"
    try:
        __import__(module)
    except (ImportError, OSError) as error:
        return extras.explain(error) or str(error)
    return "loads"
