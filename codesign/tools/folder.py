"""Folder of a run of a design tool: one configuration, one process at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from softgym_envs.codesign.scheduling.storage import file_lock
from softgym_envs.config import (
    Config,
    check_compatible,
    continue_with_code,
    load_stored,
    save_config,
    save_resolved,
)
from softgym_envs.errors import ConfigError

CONTINUED = ("journal.log", "evaluations.jsonl")
"""Results that a later run adds to."""
RESULTS = (*CONTINUED, "result.json")


@contextmanager
def run_folder(
    folder: str | Path, config: Config, kind: str, *, may_change: Sequence[str] = ("name",), progress: bool = False
) -> Iterator[Path]:
    """Reserve a folder for one run while the block runs, and write the resolved configuration there.

    A run that continues another keeps the provenance of the first, and notes there if its code is another.

    Args:
        folder: a new one, or one with results of the same configuration.
        config: the configuration of the run.
        kind: what the run is, with its article, for messages: ``"a search"``, ...
        may_change: dotted keys of the configuration that may differ from those of earlier results.
        progress: warn on standard error if other code began the run.

    Yields:
        The folder.

    Raises:
        ConfigError: if the folder holds results of another configuration or of another tool, or if another process
            uses it.
    """
    import click
    from filelock import Timeout

    folder = Path(folder)
    _check(folder, config, kind, may_change)  # before the lock is written to a folder of something else
    lock = file_lock(folder, "run")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ConfigError(f"folder '{folder}' is in use by another process; wait, or use another folder") from None
    try:
        _check(folder, config, kind, may_change)  # another process may have been faster
        if any((folder / name).exists() for name in CONTINUED):
            save_config(folder, config)
            change = continue_with_code(folder)
            if change and progress:
                click.echo(f"warning: {kind} in '{folder}' was {change}; what they compute may differ", err=True)
        else:
            save_resolved(folder, config)
        yield folder
    finally:
        lock.release()


def _check(folder: Path, config: Config, kind: str, may_change: Sequence[str]) -> None:
    """Raise ConfigError unless a run may use a folder; see `run_folder`."""
    path = folder / "config.yaml"
    results = [name for name in RESULTS if (folder / name).exists()]
    if not path.exists():
        if results:
            raise ConfigError(f"folder '{folder}' holds {results[0]} but no config.yaml; use another folder")
        return
    old = load_stored(folder, type(config), kind)
    if results:
        check_compatible(old, config, f"folder '{folder}' holds {kind}", may_change=may_change)
