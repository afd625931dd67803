"""Files that are either whole or absent, and where caches live."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from softgym_envs.errors import DataError

if TYPE_CHECKING:
    import numpy as np

__all__ = ["atomic_write", "cache_directory", "read_json", "read_npz", "write_json"]


@contextmanager
def atomic_write(path: str | Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a temporary file beside ``path`` and move it there when the block ends without an error."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, mode) as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_npz(path: str | Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Read arrays by name from an npz file, without pickle.

    Raises:
        DataError: if the file is missing, truncated or lacks an array.
    """
    import numpy as np

    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as data:
            missing = sorted(set(names) - set(data.files))
            if missing:
                raise DataError(f"'{path}' lacks {', '.join(missing)}")
            return {name: data[name] for name in names}
    except (OSError, ValueError, EOFError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"'{path}' cannot be read: {error}") from error


def read_json(path: str | Path) -> Any:
    """Read a JSON file.

    Raises:
        DataError: if the file is missing, truncated or no JSON.
    """
    try:
        return json.loads(Path(path).read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"'{path}' cannot be read: {error}") from None


def write_json(path: str | Path, value: object) -> None:
    """Write a JSON file atomically, indented."""
    with atomic_write(path, "w") as stream:
        json.dump(value, stream, indent=2)
        stream.write("\n")


def cache_directory(name: str) -> Path:
    """Folder of a cache: ``$SOFTGYM_CACHE`` if set, else the user's cache folder."""
    root = os.environ.get("SOFTGYM_CACHE")
    if root is None:
        from platformdirs import user_cache_dir

        root = user_cache_dir("softgym-envs", appauthor=False)
    return Path(root) / name
