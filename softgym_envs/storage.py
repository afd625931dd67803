"""Atomic file writes, and the location of caches."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import sys
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


@contextmanager
def atomic_write(path: str | Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Yield a temporary file that replaces ``path`` when the block ends without an error."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:  # such as a read-only folder; name the user's file
        error.filename = str(path)
        raise
    try:
        with os.fdopen(handle, mode) as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None:  # such as a full disk; name the user's file
            error.filename = str(path)
        raise


LARGEST_ARCHIVE = 8_000_000_000
"""Largest size of the arrays of an npz file [bytes]. A small file may claim any size and fill the memory."""


def read_npz(path: str | Path, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """Return arrays by name from an npz file, without unpickling objects; ``optional`` ones if they are there.

    Raises:
        DataError: if the file is missing, truncated or lacks an array.
    """
    import numpy as np

    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as data:
            size = sum(member.file_size for member in data.zip.infolist())
            if size > LARGEST_ARCHIVE:
                raise DataError(f"'{path}' would unpack to {size / 1e9:.3g} GB; allowed: {LARGEST_ARCHIVE / 1e9:g} GB")
            missing = sorted(set(names) - set(data.files))
            if missing:
                raise DataError(f"'{path}' lacks {', '.join(missing)}")
            return {name: data[name] for name in (*names, *(name for name in optional if name in data.files))}
    except TypeError:
        raise DataError(f"'{path}' holds one array; expected an npz file of {', '.join(names)}") from None
    except (OSError, ValueError, EOFError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"'{path}' cannot be read: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    """Return what an error says without the path, which errors of the operating system repeat."""
    return getattr(error, "strerror", None) or str(error)


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        DataError: if the file is missing, truncated or not valid JSON.
    """
    try:
        return json.loads(Path(path).read_text())
    except RecursionError:
        raise DataError(f"'{path}' cannot be read: it is nested too deeply") from None
    except json.JSONDecodeError as error:
        raise DataError(f"'{path}' cannot be read: it is truncated or not valid JSON ({error})") from None
    except (OSError, ValueError) as error:
        raise DataError(f"'{path}' cannot be read: {_reason(error)}") from None


def write_json(path: str | Path, value: object) -> None:
    """Write a JSON file atomically, indented."""
    with atomic_write(path, "w") as stream:
        json.dump(value, stream, indent=2)
        stream.write("\n")


SIGNATURE = "sha256"
"""Key of a signed JSON file: the hash of its name and of everything else in it."""

RESTORE = "restore it from a copy, or begin anew in another folder"
"""What to do about a damaged file that nothing can compute again."""


def write_signed(path: str | Path, value: dict[str, Any]) -> None:
    """Write a JSON file atomically, with a hash by which `read_signed` notices that it was edited or damaged."""
    content = {key: item for key, item in value.items() if key != SIGNATURE}
    write_json(path, {**content, SIGNATURE: _signature(path, content)})


def read_signed(path: str | Path, remedy: str = RESTORE) -> dict[str, Any]:
    """Return what `write_signed` wrote.

    Args:
        path: the file; it must have the name with which it was written.
        remedy: what to do if it is damaged, for the message.

    Raises:
        DataError: if the file is missing, truncated, edited or renamed.
    """
    try:
        content = read_json(path)
    except DataError as error:
        raise DataError(f"{error}; {remedy}") from None
    signature = content.pop(SIGNATURE, None) if isinstance(content, dict) else None
    if signature is None or signature != _signature(path, content):
        raise DataError(
            f"'{path}' was edited, damaged or renamed after it was written, so that it may show what was never "
            f"computed; {remedy}"
        )
    return content


def _signature(path: str | Path, content: dict[str, Any]) -> str:
    text = json.dumps(json.loads(json.dumps(content)), sort_keys=True)
    return hashlib.sha256(f"{Path(path).name}\n{text}".encode()).hexdigest()


def hash_of(path: str | Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def drop_torn_line(path: str | Path) -> None:
    """Remove an incomplete last line of an append-only file, as left by a crash in the middle of a write.

    Call this only while no other process writes to the file.
    """
    path = Path(path)
    if not path.exists():
        return
    with path.open("rb+") as stream:
        content = stream.read()
        if not content.endswith(b"\n"):
            stream.truncate(content.rfind(b"\n") + 1)


class JsonLines:
    """Append-only file with one JSON record per line, which survives a crash in the middle of a write.

    Each line has a hash by which an edited one is noticed.

    Args:
        path: the file; it need not exist yet. Only one process may write to it at a time.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        drop_torn_line(self.path)

    def read(self) -> list[dict[str, Any]]:
        """Return all records, in the order in which they were written.

        Raises:
            DataError: if a line is damaged or was edited; the message names the line.
        """
        if not self.path.exists():
            return []
        records = []
        for number, line in enumerate(self.path.read_bytes().splitlines(), start=1):
            try:
                record = json.loads(line)
            except (ValueError, RecursionError):
                record = None
            if not isinstance(record, dict) or record.pop(SIGNATURE, None) != _signature(self.path, record):
                raise DataError(
                    f"'{self.path}', line {number} is damaged or was edited; remove it to compute its record again"
                )
            records.append(record)
        return records

    def append(self, record: dict[str, Any]) -> None:
        """Write one record at the end."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as stream:
            stream.write(json.dumps({**record, SIGNATURE: _signature(self.path, record)}) + "\n")


def cache_directory(name: str) -> Path:
    """Return the folder of a cache: in ``$SOFTGYM_CACHE`` if that is set, else in the user's cache folder.

    Where that cannot be written, as in a container without a home, it is in a temporary folder of the user; one line on
    standard error says so.
    """
    root = os.environ.get("SOFTGYM_CACHE")
    if root is None:
        from platformdirs import user_cache_dir

        root = user_cache_dir("softgym-envs", appauthor=False)
    return _writable_root(root) / name


@functools.cache
def _writable_root(root: str) -> Path:
    if is_writable(Path(root)):
        return Path(root)
    private = Path(tempfile.gettempdir(), f"softgym-envs-{os.getuid() if hasattr(os, 'getuid') else 'user'}")
    private.mkdir(mode=0o700, exist_ok=True)
    status = private.stat()
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o022):  # another user's
        private = Path(tempfile.mkdtemp(prefix="softgym-envs-"))
    print(
        f"softgym-envs: caches are kept in '{private}', since '{root}' cannot be written; set SOFTGYM_CACHE",
        file=sys.stderr,
    )
    os.environ["SOFTGYM_CACHE"] = str(private)  # processes started from here share it
    return private


def is_writable(folder: Path) -> bool:
    """Return whether files can be written to a folder, which is made if it does not exist."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
