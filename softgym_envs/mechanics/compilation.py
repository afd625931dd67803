"""Compiled kernels: a cache that notices edits of any kernel, and a line that explains the wait for compilation.

Numba keeps compiled functions on disk until their own file changes, although they contain the code of functions from
other files. Modules of this package therefore import `njit` from here: a cached function is compiled again when any
file changes that its code may come from.

Kernels that neither allocate nor return arrays are compiled with ``_nrt=False``: they count no references to the arrays
that they take out of records and slice, which took half of the time of bodies of beams. Kernels that they call inherit
that; where these allocate, they are compiled with ``_nrt=True``.

Compiled functions get records with all of their arrays by value: a call that passes the hundred arrays of a body of
beams writes ten kilobytes. Small kernels that are called thousands of times in a step are compiled with
``forceinline=True``; kernels that they call inherit that, too, so these say ``forceinline=False``.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import sys
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, event

from softgym_envs.storage import cache_directory, is_writable

ANNOUNCED = "SOFTGYM_COMPILATION_ANNOUNCED"
"""Environment variable that is set once the line has been printed; worker processes inherit it."""
FAST = {"contract", "nsz", "reassoc"}
"""What compilers may do with sums (``fastmath``): rounding changes, but not what follows from infinities and NaN."""
ROOT = Path(__file__).resolve().parents[1]
"""Folder of the package."""
_IMPORT = re.compile(rf"^from ({ROOT.name}[.\w]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)

njit: Any = numba.njit  # its types know no _nrt


@functools.cache
def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _imported_sources(text: str) -> set[Path]:
    """Return the files from which a kernel's file imports kernels, or constants and types that kernels may use."""
    found = set()
    for module, names in _IMPORT.findall(text):
        path = ROOT.joinpath(*module.split(".")[1:]).with_suffix(".py")
        if path.is_file() and ("njit" in _text(path) or re.search(r"\b[A-Z]", names)):
            found.add(path)
    return found


@functools.cache
def source_hash(path: Path) -> str:
    """Return a hash of all files of this package that the kernels in one of its files depend on."""
    known: dict[Path, str] = {}
    waiting = [path]
    while waiting:
        file = waiting.pop()
        if file not in known:
            known[file] = _text(file)
            if "njit" in known[file]:  # constants and types of other files do not depend on kernels
                waiting.extend(_imported_sources(known[file]))
    digest = hashlib.sha256()
    for file in sorted(known):
        digest.update(f"{file.relative_to(ROOT)}\0{known[file]}\0".encode())
    return digest.hexdigest()


def _stamp_with_sources() -> None:
    """Let Numba's cache compare what kernels of this package depend on, and not their own files alone."""
    locator: Any = caching._SourceFileBackedLocatorMixin
    own_stamp = locator.get_source_stamp

    def get_source_stamp(self: Any) -> Any:
        path = Path(self._py_file).resolve()
        return (own_stamp(self), source_hash(path)) if ROOT in path.parents else own_stamp(self)

    locator.get_source_stamp = get_source_stamp


def _forget_what_is_gone() -> None:
    """Let Numba compile again where a cache names a module or type that no longer exists, as after an upgrade.

    An index is unpickled, with the types of arguments, before its stamp is compared.
    """
    index: Any = caching.IndexDataCacheFile
    own_index = index._load_index

    def _load_index(self: Any) -> Any:
        try:
            return own_index(self)
        except (ImportError, AttributeError):
            return {}

    index._load_index = _load_index


_stamp_with_sources()
_forget_what_is_gone()


def _choose_cache() -> None:
    """Keep compiled kernels beside the package, or where that cannot be written in `cache_directory`."""
    config: Any = numba.config
    if not config.CACHE_DIR and not is_writable(Path(__file__).parent / "__pycache__"):
        config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = str(cache_directory("kernels"))


_choose_cache()


class _Announcement(event.Listener):
    """Prints one line before the first kernel of the package is compiled."""

    def on_start(self, event: event.Event) -> None:
        module = getattr(event.data["dispatcher"].py_func, "__module__", None) or ""  # None where code made it
        if module.startswith("softgym_envs.") and ANNOUNCED not in os.environ:
            os.environ[ANNOUNCED] = "1"
            print(
                "softgym-envs: compiling numerical kernels (a minute or two); later runs load them from a cache",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: event.Event) -> None:
        pass


def announce_compilation() -> None:
    """Print a line when the first kernel of the package is compiled, in this process or one that it starts."""
    event.register("numba:compile", _Announcement())
