"""Storage of a study in a PostgreSQL database that many machines share.

Everything that belongs together is one transaction, Optuna's own writes included. If the worker, the network or the
server fails, the transaction has no effect and runs again. An advisory lock lets transactions run one after another.

Workers send heartbeats, timed by the clock of the server. A worker counts as dead after ``grace`` seconds without one;
time during which the server was down does not count. If such a worker comes back, it finds its trial reassigned and
drops its result.
"""

from __future__ import annotations

import random
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from typing import TYPE_CHECKING, Any, TypeVar

from softgym_envs.codesign.metrics.metric import Direction
from softgym_envs.codesign.scheduling.storage import SharedStorage
from softgym_envs.errors import ConfigError, SoftGymError

if TYPE_CHECKING:
    import optuna
    from sqlalchemy.engine import Connection

T = TypeVar("T")

MAX_TRIES = 20
"""Number of times that one action is tried; waiting for a server that is down counts as one."""

IDLE_LIMIT = 60.0
"""Time after which the server ends the transaction of a machine that stopped inside it [s]."""

# Either side notices a lost peer within half a minute; all machines read times in the same time zone.
CONNECTION = {
    "connect_timeout": 10,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 4,
    "tcp_user_timeout": 30_000,
    "options": "-c timezone=UTC -c tcp_keepalives_idle=10 -c tcp_keepalives_interval=5 -c tcp_keepalives_count=4",
}

SAVEPOINT = "optuna"
"""Savepoint to which a failed write of Optuna goes back inside a transaction."""

TABLES = """
CREATE TABLE IF NOT EXISTS codesign_workers (worker text PRIMARY KEY, seen timestamptz NOT NULL);
CREATE TABLE IF NOT EXISTS codesign_files (
    study_id integer NOT NULL REFERENCES studies ON DELETE CASCADE,
    path text NOT NULL,
    content bytea NOT NULL,
    PRIMARY KEY (study_id, path)
);
"""
HEARTBEAT = """
INSERT INTO codesign_workers VALUES (:worker, clock_timestamp())
ON CONFLICT (worker) DO UPDATE SET seen = clock_timestamp()
"""
LIVES = """
SELECT clock_timestamp() - greatest(seen, pg_postmaster_start_time()) < make_interval(secs => :grace)
FROM codesign_workers WHERE worker = :worker
"""
# Processes that were killed at the same instant sent their last heartbeats up to a sixth of the grace apart.
OUTLIVED = """
SELECT clock_timestamp() - greatest(call.seen, pg_postmaster_start_time()) < make_interval(secs => :grace)
    AND (worker.seen IS NULL OR call.seen > worker.seen + make_interval(secs => :grace / 3))
FROM codesign_workers call LEFT JOIN codesign_workers worker ON worker.worker = :worker
WHERE call.worker = :call
"""
PUBLISH = """
INSERT INTO codesign_files SELECT study_id, :path, :content FROM studies WHERE study_name = :study
ON CONFLICT DO NOTHING
"""
HAS_FILES = """
SELECT EXISTS (SELECT FROM codesign_files JOIN studies USING (study_id)
               WHERE study_name = :study AND path LIKE :pattern)
"""
FETCH = "SELECT content FROM codesign_files JOIN studies USING (study_id) WHERE study_name = :study AND path = :path"


class PostgresStorage(SharedStorage):
    """A study in a PostgreSQL database.

    Besides Optuna's tables the database has two: heartbeats of the workers, and files (policies, results of jobs). The
    database is all that the machines need to have in common.

    Args:
        address: ``postgresql://user@host:port/database``; the password comes from ``~/.pgpass`` or ``PGPASSWORD``.
        study: name of the study.
        grace: time without a heartbeat after which a worker counts as dead [s].
        patience: how long to wait for a server that does not answer [s].
        wait: whether to wait for the server when the storage is opened.

    Raises:
        ConfigError: if the database cannot be opened.
    """

    form = "postgresql://user@host:port/database"

    @classmethod
    def takes(cls, address: str) -> bool:
        from sqlalchemy.engine import make_url
        from sqlalchemy.exc import ArgumentError

        try:
            url = make_url(address)
        except (ArgumentError, ValueError):
            return False
        return url.get_backend_name() == "postgresql" and bool(url.database)

    def __init__(
        self, address: str, study: str, *, grace: float = 60.0, patience: float = 600.0, wait: bool = False
    ) -> None:
        import sqlalchemy as sql
        from optuna.exceptions import OptunaError

        try:
            import psycopg  # noqa: F401 - imported here to name the extra that installs it
        except ImportError as error:
            raise ConfigError(
                f"storage '{address}' needs psycopg ({error}): pip install 'softgym-envs[postgres]'"
            ) from None
        self.address = address
        self.study = study
        self.grace = grace
        self.patience = patience
        self._url = sql.engine.make_url(address).set(drivername="postgresql+psycopg")
        self._held: Any = None  # connection of the present transaction
        self._engine = sql.create_engine(self._url, **self._options(self._connect))
        try:
            self._storage = self.patiently(self._open) if wait else self._open()
        except (sql.exc.SQLAlchemyError, OptunaError, RuntimeError) as error:
            raise ConfigError(f"storage '{address}' cannot be opened: {_reason(error)}") from None

    def _open(self) -> optuna.storages.RDBStorage:
        import optuna
        from sqlalchemy import text

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        with self._engine.begin() as connection:  # two machines may find an empty database at the same time
            self._lock(connection, "tables")
            shared = self._options(lambda: self._connect() if self._held is None else self._held)
            storage = optuna.storages.RDBStorage(self._url.render_as_string(), engine_kwargs=shared)
            connection.execute(text(TABLES))
        return storage

    def _options(self, connect: Callable[[], Any]) -> dict[str, Any]:
        import sqlalchemy as sql

        # Workers hold no connection while they train: there may be hundreds.
        return {"poolclass": sql.NullPool, "creator": connect, "use_native_hstore": False}

    def _connect(self) -> Any:
        arguments, options = self._engine.dialect.create_connect_args(self._url)
        return _connection_class().connect(*arguments, **{**options, **CONNECTION})

    @property
    def optuna(self) -> optuna.storages.BaseStorage:
        return self._storage

    # -- transactions -----------------------------------------------------------------------------------------------

    def exclusively(self, action: Callable[[], T]) -> T:
        return self.patiently(lambda: self._transaction(action))

    def _transaction(self, action: Callable[[], T]) -> T:
        from sqlalchemy import text

        done = False
        try:
            with self._engine.begin() as connection:
                connection.execute(text(f"SET LOCAL idle_in_transaction_session_timeout = '{IDLE_LIMIT:g}s'"))
                self._lock(connection, f"study {self.study}")
                connection.execute(text(f"SAVEPOINT {SAVEPOINT}"))
                with self._shared(connection.connection.driver_connection):
                    result = action()
            done = True
            return result
        finally:
            if not done:  # it has cached what was never written
                self.opened = None

    @contextmanager
    def _shared(self, connection: Any) -> Iterator[None]:
        """Let Optuna work on this connection, as a part of its transaction, while the block runs."""
        self._held, connection.held = connection, True
        try:
            yield
        finally:
            self._held, connection.held = None, False

    @staticmethod
    def _lock(connection: Connection, name: str) -> None:
        """Wait for an advisory lock; it is held until the end of the transaction."""
        from sqlalchemy import text

        connection.execute(text("SELECT pg_advisory_xact_lock(hashtextextended(:name, 0))"), {"name": _key(name)})

    def patiently(self, action: Callable[[], T]) -> T:
        from optuna.exceptions import StorageInternalError
        from sqlalchemy.exc import SQLAlchemyError

        for attempt in range(1, MAX_TRIES + 1):
            try:
                return action()
            except (StorageInternalError, SQLAlchemyError) as error:
                if not _may_succeed_later(error) or attempt == MAX_TRIES:
                    raise SoftGymError(f"storage '{self.address}' failed: {_reason(error)}") from error
                self._wait(error)
        raise AssertionError

    def _wait(self, error: Exception) -> None:
        """Wait until the server answers; ask less and less often.

        Raises:
            SoftGymError: if it does not within ``patience``.
        """
        from sqlalchemy import text
        from sqlalchemy.exc import SQLAlchemyError

        start, delay, reported = time.monotonic(), 0.1, False
        while True:
            time.sleep(delay * random.uniform(0.5, 1.0))  # so that the workers do not ask all at once
            try:
                with self._engine.connect() as connection:
                    connection.execute(text("SELECT 1"))
            except SQLAlchemyError as failure:
                error = failure
            else:
                if reported:
                    self._say(f"answers again after {time.monotonic() - start:.0f} s")
                return
            if time.monotonic() - start > self.patience:
                raise SoftGymError(
                    f"storage '{self.address}' has not answered for {self.patience:g} s: {_reason(error)}; nothing "
                    "finished is lost: start the server and run the same command again"
                ) from None
            if not reported:
                self._say(f"does not answer, waiting up to {self.patience:g} s: {_reason(error)}")
                reported = True
            delay = min(2.0 * delay, 5.0)

    def _say(self, line: str) -> None:
        print(f"storage '{self.address}' {line}", file=sys.stderr, flush=True)

    # -- the study --------------------------------------------------------------------------------------------------

    def agree(
        self, accept: Callable[[dict[str, Any] | None], dict[str, Any]], directions: Sequence[Direction] = ("minimize",)
    ) -> dict[str, Any]:
        def action() -> dict[str, Any]:
            import optuna

            try:
                study = optuna.load_study(study_name=self.study, storage=self.optuna)
                old = study.user_attrs
            except KeyError:
                study, old = None, None
            new = accept(old)
            if study is None:
                study = optuna.create_study(study_name=self.study, storage=self.optuna, directions=directions)
            new["id"] = uuid.uuid4().hex if old is None else old["id"]
            for key, value in new.items():
                if old is None or old.get(key) != value:
                    study.set_user_attr(key, value)
            return new

        return self.exclusively(action)

    # -- workers ----------------------------------------------------------------------------------------------------

    @contextmanager
    def present(self, worker: str) -> Iterator[None]:
        from sqlalchemy.exc import SQLAlchemyError

        ended = threading.Event()
        self.patiently(lambda: self.execute(HEARTBEAT, worker=worker))

        def send() -> None:
            while not ended.wait(self.grace / 6.0):
                try:
                    self.execute(HEARTBEAT, worker=worker)
                except SQLAlchemyError:  # the next one may arrive
                    continue

        thread = threading.Thread(target=send, name="heartbeat", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            try:
                self.execute("DELETE FROM codesign_workers WHERE worker = :worker", worker=worker)
            except SQLAlchemyError as error:  # the worker counts as dead a little later
                self._say(f"could not record the end of {worker}: {_reason(error)}")

    def lives(self, worker: str) -> bool:
        return bool(self.execute(LIVES, worker=worker, grace=self.grace))

    def outlived(self, call: str, worker: str) -> bool:
        return bool(self.execute(OUTLIVED, call=call, worker=worker, grace=self.grace))

    # -- jobs and files ---------------------------------------------------------------------------------------------

    @contextmanager
    def attempt(self, job: str) -> Iterator[bool]:
        """Try to lock a job.

        A restart of the server frees the lock. Another worker may then run the job too, with the same result; the
        result that is published first counts.
        """
        connection, mine = self.patiently(lambda: self._try_lock(f"job {self.study} {job}"))
        try:
            yield mine
        finally:
            connection.close()

    def _try_lock(self, name: str) -> tuple[Connection, bool]:
        """Return a connection, and whether it holds an advisory lock; the lock ends with the connection."""
        from sqlalchemy import text

        connection = self._engine.connect()
        try:
            statement = text("SELECT pg_try_advisory_lock(hashtextextended(:name, 0))")
            mine = bool(connection.scalar(statement, {"name": _key(name)}))
            connection.commit()
            return connection, mine
        except BaseException:
            connection.close()
            raise

    def publish(self, files: Mapping[str, bytes]) -> None:
        for path, content in files.items():
            parameters = {"study": self.study, "path": path, "content": content}
            self.patiently(partial(self.execute, PUBLISH, **parameters))

    def fetch(self, name: str) -> bytes | None:
        content = self.patiently(lambda: self.execute(FETCH, study=self.study, path=name))
        return None if content is None else bytes(content)

    def has_files(self, folder: str) -> bool:
        return bool(self.execute(HAS_FILES, study=self.study, pattern=f"{folder}/%"))

    def execute(self, statement: str, **parameters: Any) -> Any:
        """Run a statement and return its first value, or None."""
        from sqlalchemy import text

        with self._engine.begin() as connection:
            found = connection.execute(text(statement), parameters)
            return found.scalar() if found.returns_rows else None


@cache
def _connection_class() -> Any:
    import psycopg

    class Connection(psycopg.Connection):
        """A connection whose transaction Optuna may be made a part of: its commits are then savepoints."""

        held = False

        def commit(self) -> None:
            if self.held:
                self.execute(f"RELEASE SAVEPOINT {SAVEPOINT}")
                self.execute(f"SAVEPOINT {SAVEPOINT}")
            else:
                super().commit()

        def rollback(self) -> None:
            if self.held:
                self.execute(f"ROLLBACK TO SAVEPOINT {SAVEPOINT}")
            else:
                super().rollback()

        def close(self) -> None:
            if not self.held:
                super().close()

    return Connection


def _key(name: str) -> str:
    return f"softgym codesign {name}"


def _may_succeed_later(error: BaseException) -> bool:
    """Return whether an error is a lost connection or a conflict, so that the same action may succeed later."""
    from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError, PendingRollbackError

    cause = error.__cause__ if type(error).__name__ == "StorageInternalError" else error
    lost = isinstance(cause, DBAPIError) and cause.connection_invalidated
    return lost or isinstance(cause, (OperationalError, InterfaceError, PendingRollbackError))


def _reason(error: BaseException) -> str:
    """Return the first line of the database's message."""
    from sqlalchemy.exc import DBAPIError

    cause = error.__cause__ if type(error).__name__ == "StorageInternalError" and error.__cause__ else error
    text = str(cause.orig if isinstance(cause, DBAPIError) else cause)
    return next(iter(text.strip().splitlines()), type(cause).__name__)
