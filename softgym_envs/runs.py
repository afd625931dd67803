"""Folders of runs: what studies, searches, calibrations, trainings, fits and sweeps write beside their results.

`RunFolder` says which configuration and which code made a folder, who may continue it, and who is working in it.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic

import yaml

from softgym_envs.config import Config, ModelT, difference, load_config
from softgym_envs.errors import ConfigError, DataError
from softgym_envs.storage import RESTORE, atomic_write, read_signed, write_signed
from softgym_envs.version import __version__

if TYPE_CHECKING:
    from filelock import BaseFileLock

RESULTS = ("journal.log", "evaluations.jsonl", "result.json")
"""Files that a later run of a design tool reads; it adds to all but the last."""


class RunFolder(Generic[ModelT]):
    """The folder of a run, which another call may continue.

    It holds ``config.yaml`` (the resolved configuration), ``provenance.json`` (the code that began the run, and other
    code that continued it) and ``locks/`` beside the results. Every file is either whole or absent.

    Args:
        path: the folder; it need not exist.
        model: class of the configuration.
        kind: what the run is, with its article, for messages: ``"a search"``.
    """

    def __init__(self, path: str | Path, model: type[ModelT], kind: str) -> None:
        self.path = Path(path)
        self.model, self.kind = model, kind

    @property
    def begun(self) -> bool:
        """Whether the folder has a configuration."""
        return (self.path / "config.yaml").exists()

    @functools.cached_property
    def config(self) -> ModelT:
        """The resolved configuration.

        Raises:
            ConfigError: if the folder holds something else, or its configuration cannot be read.
            DataError: if it holds no run, or its configuration is damaged.
        """
        if not self.begun:
            raise DataError(
                f"'{self.path}' is not the folder of {self.kind}: it has no config.yaml; name another folder"
            )
        file = self.path / "config.yaml"
        try:
            head, _, content = file.read_text().partition("\n")
            if head != _signature(content):
                _check_yaml(file, f"{head}\n{content}")
                raise ConfigError(
                    "its config.yaml was edited after the run began, or is incomplete, so that its results would stand "
                    "under another configuration; edit a copy elsewhere"
                )
            return load_config(file, self.model)
        except UnicodeDecodeError as error:
            raise DataError(f"'{file}' is damaged ({error}); {RESTORE}") from None
        except (ConfigError, OSError) as error:
            raise ConfigError(f"folder '{self.path}' does not hold {self.kind}: {error}; use another folder") from None

    def begin(self, config: ModelT) -> None:
        """Write the configuration and the provenance of a new run."""
        self.keep(config)
        write_signed(self.path / "provenance.json", provenance())

    def keep(self, config: ModelT) -> None:
        """Write the configuration with which a run continues; its provenance stays."""
        content = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
        with atomic_write(self.path / "config.yaml", "w") as stream:
            stream.write(f"{_signature(content)}\n{content}")
        self.__dict__.pop("config", None)

    def accept(self, config: ModelT, may_change: Sequence[str] = ()) -> None:
        """Check that the run can be continued with a configuration; see `check_compatible`."""
        check_compatible(self.config, config, f"folder '{self.path}' holds {self.kind}", may_change=may_change)

    def lock(self, name: str) -> BaseFileLock:
        """Return a lock shared by all processes of the folder."""
        return file_lock(self.path, name)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Hold the folder for this process; a ConfigError if another process does."""
        from filelock import Timeout

        lock = self.lock("run")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            raise ConfigError(
                f"folder '{self.path}' is in use by another process; wait, or use another folder"
            ) from None
        try:
            yield
        finally:
            lock.release()

    @contextmanager
    def reserve(
        self, config: ModelT, may_change: Sequence[str] = ("name",), *, progress: bool = False
    ) -> Iterator[Path]:
        """Hold the folder of a design tool while the block runs; begin the run there, or continue it.

        Args:
            config: the configuration of the run.
            may_change: dotted keys of the configuration that may differ from those of earlier results.
            progress: warn on standard error if other code began the run.

        Yields:
            The folder.

        Raises:
            ConfigError: if the folder holds results of another configuration or of another tool, or if another process
                uses it.
        """
        self._check(config, may_change)  # before the lock is written to a folder of something else
        with self.alone():
            self._check(config, may_change)  # another process may have been faster
            if any((self.path / name).exists() for name in RESULTS[:-1]):
                self.keep(config)
                if (change := self.continued()) and progress:
                    print(f"warning: {change}", file=sys.stderr)
            else:
                self.begin(config)
            yield self.path

    def _check(self, config: ModelT, may_change: Sequence[str]) -> None:
        results = [name for name in RESULTS if (self.path / name).exists()]
        if not self.begun:
            if results:
                raise ConfigError(f"folder '{self.path}' holds {results[0]} but no config.yaml; use another folder")
            return
        self.__dict__.pop("config", None)
        if results:
            self.accept(config, may_change)
        else:
            self.config  # noqa: B018 - raises where the folder holds something else

    def continued(self) -> str:
        """Record other code than began the run; return a warning, or ``""`` if it is the same.

        Call it before the first work that the folder does not have yet.
        """
        change = continue_with_code(self.path)
        return (
            f"{self.kind.partition(' ')[2]} '{self.path}' was {change}; what they compute may differ" if change else ""
        )

    def stamp(self) -> dict[str, Any]:
        """Return the provenance of a result of this call, with all changes of the code during the run."""
        return {**provenance(), "code_changes": code_changes(self.path)}


def _check_yaml(file: Path, content: str) -> None:
    """Raise DataError if a configuration cannot be read at all, as where it was cut off or overwritten."""
    try:
        yaml.safe_load(content)
    except (yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split()) if isinstance(error, yaml.YAMLError) else "nested too deeply"
        raise DataError(f"'{file}' is damaged ({reason}); {RESTORE}") from None


def _signature(content: str) -> str:
    """Return the first line of a stored configuration, by which an edited one is noticed."""
    return f"# SHA-256 {hashlib.sha256(content.encode()).hexdigest()}"


def file_lock(folder: Path, name: str) -> BaseFileLock:
    """Return a lock shared by all processes of a folder. The operating system frees it when its holder dies."""
    from filelock import FileLock

    (folder / "locks").mkdir(parents=True, exist_ok=True)
    return FileLock(folder / "locks" / f"{name}.lock", poll_interval=0.01)


def check_compatible(
    old: Config, new: Config, found: str, *, may_change: Sequence[str] = (), use: str = "folder"
) -> None:
    """Check that stored results can be continued with a new configuration.

    Args:
        old: the configuration of the results.
        new: the requested configuration.
        found: location and kind of the results, for the message: ``"folder 'x' holds a search"``.
        may_change: dotted keys that may differ.
        use: what to change to start afresh: ``"folder"`` or ``"name"``.

    Raises:
        ConfigError: one line naming the first key that differs, both values, and the keys that may differ.
    """
    other = difference(old, new, ignore=may_change)
    if other is not None:
        allowed = f", or change only: {', '.join(may_change)}" if may_change else ""
        raise ConfigError(f"{found} with {other}; use another {use}{allowed}")


def commit_of(root: Path) -> str | None:
    """Return the git commit of a source tree, with ``-dirty`` if files are modified, or None if it is unknown.

    In a clone, git provides the commit; a source archive (``git archive``, a downloaded tag) stores it in a file.
    """
    archived = root / ".git_archival.txt"
    if (root / ".git").exists():
        try:
            done = subprocess.run(
                ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"],
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() or None
    if archived.exists():
        node = archived.read_text().removeprefix("node:").strip()
        return None if node.startswith("$") else node[:12]
    return None


_NOT_SOURCES = ("configs", "agents/results", "extensions/leaderboard/data")
"""Folders of the package that results do not follow from: a run keeps its configuration, and the others are records."""


@functools.cache
def _source_hash() -> str:
    """Return a hash of the package's code, weights and meshes; it is the same in a checkout and in an installation."""
    root = Path(__file__).resolve().parent
    files: dict[str, Path] = {}
    for folder, inside, names in os.walk(root, followlinks=True):  # agents and codesign may be links
        place = Path(folder).relative_to(root)
        inside[:] = [name for name in inside if (place / name).as_posix() not in _NOT_SOURCES]
        files |= {(place / name).as_posix(): Path(folder, name) for name in names}
    digest = hashlib.sha256()
    for name in sorted(files):
        if name.endswith((".py", ".json", ".npz", ".safetensors")) and files[name].is_file():  # no broken links
            digest.update(f"{name}\0".encode() + hashlib.sha256(files[name].read_bytes()).digest())
    return digest.hexdigest()[:12]


def provenance() -> dict[str, Any]:
    """Return the origin of a result: versions, git commit, hash of the package's sources, time and machine."""
    versions = {"softgym-envs": __version__, "python": platform.python_version()}
    for package in ("numpy", "scipy", "torch", "gymnasium", "stable-baselines3", "optuna", "gmsh", "proxsuite"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    commit = commit_of(Path(__file__).resolve().parent.parent)
    return {
        "commit": commit,
        "sources": _source_hash(),
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "platform": platform.platform(),
        "versions": versions,
    }


def code_change(begun: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return how the code differs between two of `provenance`: ``"begun with A; continued with B"``, or ``""``.

    A commit, hash of the sources or version that one of them does not know is no difference. Commits whose sources are
    equal differ in tests or documentation only, and are no difference either.
    """
    before, after = (
        {**{key: made.get(key) for key in ("commit", "sources")}, **made.get("versions", {})} for made in (begun, now)
    )
    changed = [name for name in before if None not in (before[name], after.get(name)) and before[name] != after[name]]
    if "commit" in changed and "sources" in changed:
        changed.remove("sources")
    elif "commit" in changed and before["sources"] and after["sources"]:
        changed.remove("commit")
    if not changed:
        return ""
    old, new = (", ".join(f"{name} {made[name]}" for name in changed) for made in (before, after))
    return f"begun with {old}; continued with {new}"


def continue_with_code(folder: str | Path) -> str:
    """Record in the provenance of a results folder that other code than began it continues it.

    Call it before the first work that the folder does not have yet.

    Returns:
        The `code_change`, for a warning.
    """
    path = Path(folder) / "provenance.json"
    if not path.exists():
        return ""
    begun, now = read_signed(path), provenance()
    change = code_change(begun, now)
    continued = begun.get("continued", [])
    if change and all(code_change(begun, other) != change for other in continued):
        write_signed(path, {**begun, "continued": [*continued, now]})
    return change


def code_changes(folder: str | Path) -> list[str]:
    """Return each `code_change` that `continue_with_code` recorded in a results folder."""
    path = Path(folder) / "provenance.json"
    begun = read_signed(path) if path.exists() else {}
    return [code_change(begun, now) for now in begun.get("continued", [])]
