"""A temporary PostgreSQL server in its own folder, on a free port of this machine."""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ACCOUNT = "postgres"
"""Account that runs the server if we are root, which PostgreSQL refuses. Debian's package creates the account."""


def find_programs() -> Path | None:
    """Return the folder of ``initdb`` and ``pg_ctl``, or None. Debian keeps them off the search path."""
    places = [Path(found).resolve().parent for found in [shutil.which("initdb"), shutil.which("pg_ctl")] if found]
    debian = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: float(path.parent.name), reverse=True)
    for place in (*places, *debian):
        if (place / "initdb").exists() and (place / "pg_ctl").exists():
            return place
    return None


class PostgresServer:
    """A server that can be stopped, started and restarted.

    Args:
        folder: an empty folder that belongs to the account that runs the server.
        programs: folder of ``initdb`` and ``pg_ctl``.

    Attributes:
        address: address of its database, in the form of Optuna and ``softgym codesign --storage``.
    """

    def __init__(self, folder: Path, programs: Path) -> None:
        self.folder = folder
        self.programs = programs
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        user = ACCOUNT if os.geteuid() == 0 else pwd.getpwuid(os.geteuid()).pw_name
        self.address = f"postgresql://{user}@127.0.0.1:{port}/postgres"
        self._options = f"-c listen_addresses=127.0.0.1 -c port={port} -c unix_socket_directories={folder}"
        self._call("initdb", "-D", str(folder / "data"), "-A", "trust", "-E", "UTF8", "--no-locale")

    def start(self) -> None:
        """Start the server and wait until it answers."""
        self._call(*self._control, "start", "-w", "-l", str(self.folder / "log"), "-o", self._options)

    def stop(self, mode: str = "fast") -> None:
        """Stop the server: ``"fast"`` ends all connections, ``"immediate"`` is a crash."""
        self._call(*self._control, "stop", "-w", "-m", mode)

    def restart(self, mode: str = "fast") -> None:
        """Stop and start the server."""
        self._call(*self._control, "restart", "-w", "-m", mode, "-l", str(self.folder / "log"), "-o", self._options)

    @property
    def _control(self) -> tuple[str, ...]:
        return ("pg_ctl", "-D", str(self.folder / "data"))

    def _call(self, program: str, *arguments: str) -> None:
        other = {"user": ACCOUNT, "group": ACCOUNT, "extra_groups": []} if os.geteuid() == 0 else {}
        done = subprocess.run(
            [str(self.programs / program), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            cwd=self.folder,
            env={"PATH": os.defpath, "LC_ALL": "C"},
            check=False,
            **other,
        )
        if done.returncode:
            raise RuntimeError(f"{program} {arguments[-1]} failed: {done.stderr.strip()}")


@contextmanager
def temporary_server() -> Iterator[PostgresServer]:
    """Run a server inside a ``with`` block.

    Raises:
        FileNotFoundError: if PostgreSQL is not installed.
    """
    programs = find_programs()
    if programs is None:
        raise FileNotFoundError("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    folder = Path(tempfile.mkdtemp(prefix="codesign-postgres-"))
    try:
        if os.geteuid() == 0:
            shutil.chown(folder, ACCOUNT, ACCOUNT)
        server = PostgresServer(folder, programs)
        server.start()
        try:
            yield server
        finally:
            server.stop()
    finally:
        shutil.rmtree(folder)
