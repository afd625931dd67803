"""Optional libraries: the extra of the package that installs each, and what to do if one is missing."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from softgym_envs.errors import MissingLibrary

EXTRAS = {
    "train": ("torch", "stable_baselines3", "pytorch_optimizer", "matplotlib"),
    "geometry": ("gmsh",),
    "viewer": ("pyvista", "vtkmodules", "rerun", "PIL"),
    "video": ("imageio_ffmpeg",),
    "codesign": ("optuna", "cmaes", "jinja2", "markupsafe", "plotly"),
    "postgres": ("psycopg", "sqlalchemy"),
    "onnx": ("onnx",),
    "minari": ("minari", "h5py", "jax"),
    "design": ("SALib",),
    "benchmark": ("pyarrow",),
    "hardware": ("serial",),
    "measured": ("c3d", "optuna", "matplotlib"),
    "optimisers": ("botorch", "ConfigSpace", "linear_operator", "optuna_integration", "ribs", "smac"),
}
"""Extra in pyproject.toml -> modules that it installs."""

SYSTEM_PACKAGES = (
    "libegl1 libfontconfig1 libgl1 libglu1-mesa libgomp1 libx11-6 libxcursor1 libxext6 libxfixes3 libxft2 libxinerama1 "
    "libxrender1"
)
"""Debian packages with the libraries that the wheels of gmsh and vtk load."""


def explain(error: ImportError | OSError) -> str | None:
    """Return one line that says how to install what an import needs, or None for any other error."""
    module = (getattr(error, "name", None) or "").partition(".")[0]
    if isinstance(error, ModuleNotFoundError):
        extra = next((extra for extra, modules in EXTRAS.items() if module in modules), None)
        return None if extra is None else _missing(module, extra)
    if "cannot open shared object file" in str(error):
        library = str(error).partition(":")[0]
        return f"{library}, a system library, is missing; on Debian or Ubuntu: apt-get install {SYSTEM_PACKAGES}"
    return None


def require(extra: str) -> None:
    """Check that an extra is installed, before work that needs it begins.

    Raises:
        MissingLibrary: one line that says what to install.
    """
    for module in EXTRAS[extra]:
        if not installed(module):
            raise MissingLibrary(_missing(module, extra))


def installed(module: str) -> bool:
    """Return whether a module can be imported, without importing it."""
    if module in sys.modules:  # some modules have no specification once they are imported
        return sys.modules[module] is not None
    return find_spec(module) is not None


def _missing(module: str, extra: str) -> str:
    return f"{module} is not installed; install it with: pip install 'softgym-envs[{extra}]'"
