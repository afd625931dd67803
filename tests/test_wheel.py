"""What an installed package contains."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = {".py", ".pyc", ".nbi", ".nbc"}


def test_all_data_files_are_in_the_wheel():
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    shipped = set()
    for package, globs in patterns.items():
        folder = (ROOT / package.replace(".", "/")).resolve()
        shipped |= {path.resolve() for pattern in globs for path in folder.glob(pattern) if path.is_file()}
    folders = [ROOT / name for name in ("softgym_envs", "agents", "codesign", "configs")]
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    needed = {path for path in files if path.suffix not in LEFT_OUT}
    assert sorted(str(path.relative_to(ROOT)) for path in needed - shipped) == []
