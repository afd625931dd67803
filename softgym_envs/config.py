"""Configuration: YAML files checked against pydantic models, with overrides from the command line."""

from __future__ import annotations

import platform
import re
import reprlib
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from softgym_envs.errors import ConfigError
from softgym_envs.storage import atomic_write, write_json
from softgym_envs.version import __version__


class Config(BaseModel):
    """Base of all configurations: unknown keys are errors, numbers are finite, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=False, allow_inf_nan=False)


class _Loader(yaml.SafeLoader):
    """YAML whose numbers are those of YAML 1.2 and JSON: ``1e-3`` is a number here, in PyYAML a word."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$"),
    list("-+0123456789."),
)


def read_value(text: str) -> Any:
    """Read YAML text; raises `yaml.YAMLError`."""
    return yaml.load(text, Loader=_Loader)


_PASSWORD = re.compile(r"(?<=[^/]):[^/@:\s]*@")
"""The password of an address, which must not end up in a log."""

ModelT = TypeVar("ModelT", bound=Config)


def load_config(path: str | Path | None, model: type[ModelT], overrides: Sequence[str] = ()) -> ModelT:
    """Read a YAML file, apply ``a.b=value`` overrides, and check the result.

    Args:
        path: the file, or None for defaults alone.
        model: what it must be.
        overrides: assignments; values are read as YAML.

    Raises:
        ConfigError: one line naming the key, its value and what is allowed.
    """
    data: Any = {}
    if path is not None:
        path = Path(path)
        try:
            data = read_value(path.read_text())
        except OSError as error:
            raise ConfigError(f"config '{path}' cannot be read: {error.strerror or error}") from None
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            where = getattr(error, "problem_mark", None)
            place = f", line {where.line + 1}" if where is not None else ""
            raise ConfigError(f"config '{path}' is not valid YAML{place}: {getattr(error, 'problem', error)}") from None
        data = {} if data is None else data
        if not isinstance(data, dict):
            raise ConfigError(f"config '{path}' must hold keys and values, got {type(data).__name__}")
    for override in overrides:
        key, separator, text = override.partition("=")
        if not separator or not key:
            raise ConfigError(f"override '{override}' must look like key=value or part.key=value")
        node = data
        *parents, last = key.split(".")
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise ConfigError(f"override '{override}': '{parent}' is a value, not a group of keys")
        try:
            node[last] = read_value(text)
        except yaml.YAMLError:
            raise ConfigError(f"override '{override}': the value is not valid YAML") from None
    return check_config(model, data, f"config '{path}'" if path is not None else "config")


def check_config(model: type[ModelT], data: dict[str, Any], where: str) -> ModelT:
    """Validate plain data, with a one-line `ConfigError` for the first problem."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"]) or "(top level)"
        message = first["msg"].removeprefix("Value error, ").replace("\n", " ")
        if first["type"] == "extra_forbidden":
            allowed = _allowed(model, [part for part in first["loc"][:-1] if isinstance(part, str)])
            message = f"unknown key; allowed: {allowed}" if allowed else "unknown key"
        elif first["type"] != "missing" and not isinstance(first["input"], dict):
            message += f", got {_PASSWORD.sub(r':***@', repr(first['input']))}"
        others = error.error_count() - 1
        more = f" (and {others} more)" if others else ""
        raise ConfigError(f"{where}: {key}: {message}{more}") from None


def difference(old: Config, new: Config, *, ignore: Sequence[str] = ()) -> str | None:
    """Describe the first value in which two configurations of one class differ: ``"sac.gamma = 0.9, got 0.95"``.

    Args:
        old: the configuration so far.
        new: the requested configuration.
        ignore: dotted keys that may differ.

    Returns:
        Dotted key and both values, long ones abridged; None if there is no difference.
    """
    return _difference(old.model_dump(mode="json"), new.model_dump(mode="json"), "", frozenset(ignore))


def _difference(old: Any, new: Any, key: str, ignore: frozenset[str]) -> str | None:
    if key in ignore:
        return None
    if isinstance(old, dict) and isinstance(new, dict) and old.keys() == new.keys():
        parts = (_difference(old[name], new[name], f"{key}.{name}" if key else name, ignore) for name in old)
        return next((part for part in parts if part is not None), None)
    return None if old == new else f"{key} = {reprlib.repr(old)}, got {reprlib.repr(new)}"


def check_compatible(
    old: Config, new: Config, found: str, *, may_change: Sequence[str] = (), use: str = "folder"
) -> None:
    """Check that stored results may be continued with a new configuration.

    Args:
        old: the configuration of the results.
        new: the requested configuration.
        found: where the results are and what they are, for the message: ``"folder 'x' holds a search"``.
        may_change: dotted keys that may differ.
        use: what to change to start again: ``"folder"`` or ``"name"``.

    Raises:
        ConfigError: one line naming the first key that differs, both values, and the keys that may differ.
    """
    other = difference(old, new, ignore=may_change)
    if other is not None:
        allowed = f", or change only: {', '.join(may_change)}" if may_change else ""
        raise ConfigError(f"{found} with {other}; use another {use}{allowed}")


def _allowed(model: type[BaseModel], path: list[str]) -> str:
    for name in path:
        field = model.model_fields.get(name)
        inner = None if field is None else field.annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return ""
        model = inner
    return ", ".join(model.model_fields)


def commit_of(root: Path) -> str | None:
    """Commit of a source tree, with ``-dirty`` where files differ from it; None where it cannot be known.

    A clone is asked by git; a source archive (``git archive``, a download of a tag) carries it in a file.
    """
    archived = root / ".git_archival.txt"
    if (root / ".git").exists():
        try:
            done = subprocess.run(
                ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"],
                capture_output=True,
                text=True,
                timeout=10,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() or None
    if archived.exists():
        node = archived.read_text().removeprefix("node:").strip()
        return None if node.startswith("$") else node[:12]
    return None


def provenance() -> dict[str, Any]:
    """What made a result: versions, git commit, time, machine."""
    versions = {"softgym-envs": __version__, "python": platform.python_version()}
    for package in ("numpy", "scipy", "torch", "gymnasium", "stable-baselines3", "optuna", "gmsh", "proxsuite"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    commit = commit_of(Path(__file__).resolve().parent.parent)
    return {
        "commit": commit,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "platform": platform.platform(),
        "versions": versions,
    }


def save_resolved(folder: str | Path, config: Config) -> None:
    """Write the resolved configuration and its provenance next to a result."""
    folder = Path(folder)
    with atomic_write(folder / "config.yaml", "w") as stream:
        yaml.safe_dump(config.model_dump(mode="json"), stream, sort_keys=False)
    write_json(folder / "provenance.json", provenance())
