"""The trials of a study in a PostgreSQL database that many machines share.

What must happen as one is one transaction of the database, Optuna's own writes included: it takes place whole, or not
at all when a worker, the network or the server goes away under it, and then it is done again. Such transactions follow
one another, by an advisory lock that ends with them.

A worker gives signs of life by the clock of the server. It counts as dead after ``grace`` seconds without one, of which
those do not count in which the server was down. One that comes back later finds its trial taken, and drops its result.
"""

from __future__ import annotations

import random
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from codesign.scheduling.storage import StudyStorage
from softgym_envs.errors import ConfigError, SoftGymError

if TYPE_CHECKING:
    import optuna
    from sqlalchemy.engine import Connection

__all__ = ["PostgresStorage"]

T = TypeVar("T")

ATTEMPTS = 20
"""Times that one action is begun; a server that is away is one of them, however long it is."""

IDLE_LIMIT = 60.0
"""A machine that stops inside a transaction keeps the others out no longer than this [s]."""

# A lost peer is told by either side within half a minute, and clocks read alike everywhere.
CONNECTION = {
    "connect_timeout": 10,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 4,
    "tcp_user_timeout": 30_000,
    "options": "-c timezone=UTC -c tcp_keepalives_idle=10 -c tcp_keepalives_interval=5 -c tcp_keepalives_count=4",
}

TABLES = """
CREATE TABLE IF NOT EXISTS codesign_workers (worker text PRIMARY KEY, seen timestamptz NOT NULL);
CREATE TABLE IF NOT EXISTS codesign_files (
    study_id integer NOT NULL REFERENCES studies ON DELETE CASCADE,
    path text NOT NULL,
    content bytea NOT NULL,
    PRIMARY KEY (study_id, path)
);
"""
SIGN = """
INSERT INTO codesign_workers VALUES (:worker, clock_timestamp())
ON CONFLICT (worker) DO UPDATE SET seen = clock_timestamp()
"""
LIVES = """
SELECT clock_timestamp() - greatest(seen, pg_postmaster_start_time()) < make_interval(secs => :grace)
FROM codesign_workers WHERE worker = :worker
"""
# Who is killed at the same instant gave the last sign up to a sixth of the grace earlier or later.
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
FETCH = "SELECT content FROM codesign_files JOIN studies USING (study_id) WHERE study_name = :study AND path = :path"


class PostgresStorage(StudyStorage):
    """A study in a PostgreSQL database.

    Beside the tables of Optuna it has two: signs of life of the workers, and files (policies, results of jobs). So the
    database is all that machines need to have in common, and whatever it tells of is there.

    Args:
        address: ``postgresql://user@host:port/database``; the password comes from ``~/.pgpass`` or ``PGPASSWORD``.
        study: name of the study.
        grace: time without a sign of life after which a worker counts as dead [s].
        patience: how long a server that went away is waited for [s].
        wait: whether to wait for it from the start.

    Raises:
        ConfigError: if the database cannot be opened.
    """

    shared = True

    def __init__(
        self, address: str, study: str, *, grace: float = 60.0, patience: float = 600.0, wait: bool = False
    ) -> None:
        import sqlalchemy as sql
        from optuna.exceptions import OptunaError

        try:
            import psycopg  # noqa: F401 - asked for here to name the extra that has it
        except ImportError as error:
            raise ConfigError(
                f"storage '{address}' needs psycopg ({error}): pip install 'softgym-envs[postgres]'"
            ) from None
        self.address = address
        self.study = study
        self.grace = grace
        self.patience = patience
        self._url = sql.engine.make_url(address).set(drivername="postgresql+psycopg").render_as_string()
        # Hundreds of workers that train hold no connections.
        self._options = {"poolclass": sql.NullPool, "connect_args": CONNECTION}
        self._engine = sql.create_engine(self._url, **self._options)
        self._cache: optuna.storages.BaseStorage | None = None
        try:
            self._storage = self.patiently(self._open) if wait else self._open()
        except (sql.exc.SQLAlchemyError, OptunaError, RuntimeError) as error:
            raise ConfigError(f"storage '{address}' cannot be opened: {_reason(error)}") from None

    def _open(self) -> optuna.storages.RDBStorage:
        import optuna
        from sqlalchemy import text

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        with self._engine.begin() as connection:  # two machines may come to an empty database at once
            self._lock(connection, "tables")
            storage = optuna.storages.RDBStorage(self._url, engine_kwargs=self._options)
            connection.execute(text(TABLES))
        return storage

    @property
    def optuna(self) -> optuna.storages.BaseStorage:
        from optuna.storages import get_storage

        if self._cache is None:
            self._cache = get_storage(self._storage)
        return self._cache

    # -- transactions -----------------------------------------------------------------------------------------------

    def exclusively(self, action: Callable[[], T]) -> T:
        return self.patiently(lambda: self._transaction(action))

    def _transaction(self, action: Callable[[], T]) -> T:
        from sqlalchemy import orm, text

        done = False
        sessions = self._storage.scoped_session
        try:
            with self._engine.begin() as connection:
                connection.execute(text(f"SET LOCAL idle_in_transaction_session_timeout = '{IDLE_LIMIT:g}s'"))
                self._lock(connection, f"study {self.study}")
                # What Optuna commits in here are parts of this transaction.
                factory = orm.sessionmaker(bind=connection, join_transaction_mode="create_savepoint")
                self._storage.scoped_session = orm.scoped_session(factory)
                result = action()
            done = True
            return result
        finally:
            self._storage.scoped_session = sessions
            if not done:  # it remembers what was never written
                self._cache = None

    @staticmethod
    def _lock(connection: Connection, name: str) -> None:
        """Wait for an advisory lock, and keep it until the end of the transaction."""
        from sqlalchemy import text

        connection.execute(text("SELECT pg_advisory_xact_lock(hashtextextended(:name, 0))"), {"name": _key(name)})

    def patiently(self, action: Callable[[], T]) -> T:
        from optuna.exceptions import StorageInternalError
        from sqlalchemy.exc import SQLAlchemyError

        for attempt in range(1, ATTEMPTS + 1):
            try:
                return action()
            except (StorageInternalError, SQLAlchemyError) as error:
                if not _went_away(error) or attempt == ATTEMPTS:
                    raise SoftGymError(f"storage '{self.address}' failed: {_reason(error)}") from error
                self._wait(error)
        raise AssertionError

    def _wait(self, error: Exception) -> None:
        """Wait until the server answers, less and less often.

        Raises:
            SoftGymError: if it does not within ``patience``.
        """
        from sqlalchemy import text
        from sqlalchemy.exc import SQLAlchemyError

        start, delay, told = time.monotonic(), 0.1, False
        while True:
            time.sleep(delay * random.uniform(0.5, 1.0))  # not all workers at once
            try:
                with self._engine.connect() as connection:
                    connection.execute(text("SELECT 1"))
            except SQLAlchemyError as failure:
                error = failure
            else:
                if told:
                    self._say(f"answers again after {time.monotonic() - start:.0f} s")
                return
            if time.monotonic() - start > self.patience:
                raise SoftGymError(
                    f"storage '{self.address}' has not answered for {self.patience:g} s: {_reason(error)}; nothing "
                    "finished is lost: start the server and run the same command again"
                ) from None
            if not told:
                self._say(f"does not answer, waiting up to {self.patience:g} s: {_reason(error)}")
                told = True
            delay = min(2.0 * delay, 5.0)

    def _say(self, line: str) -> None:
        print(f"storage '{self.address}' {line}", file=sys.stderr, flush=True)

    # -- the study --------------------------------------------------------------------------------------------------

    def agree(self, accept: Callable[[dict[str, Any] | None], dict[str, Any]], objectives: int = 1) -> dict[str, Any]:
        """Find or make the study, and what all its machines share.

        Args:
            accept: takes what is shared so far (None for a new study), returns what shall be, as plain data; what it
                raises leaves everything as it was.
            objectives: number of scores of a trial, all to be maximised.

        Returns:
            What is shared, with the ``id`` of the study.
        """

        def action() -> dict[str, Any]:
            import optuna

            try:
                study = optuna.load_study(study_name=self.study, storage=self.optuna)
                old = study.user_attrs
            except KeyError:
                study, old = None, None
            new = accept(old)
            if study is None:
                directions = [optuna.study.StudyDirection.MAXIMIZE] * objectives
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
        self.patiently(lambda: self.execute(SIGN, worker=worker))

        def signs() -> None:
            while not ended.wait(self.grace / 6.0):
                try:
                    self.execute(SIGN, worker=worker)
                except SQLAlchemyError:  # the next one may come through
                    continue

        thread = threading.Thread(target=signs, name="signs of life", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            try:
                self.execute("DELETE FROM codesign_workers WHERE worker = :worker", worker=worker)
            except SQLAlchemyError as error:  # it will count as dead a little later
                self._say(f"was not told that {worker} ended: {_reason(error)}")

    def lives(self, worker: str) -> bool:
        return bool(self.execute(LIVES, worker=worker, grace=self.grace))

    def outlived(self, call: str, worker: str) -> bool:
        return bool(self.execute(OUTLIVED, call=call, worker=worker, grace=self.grace))

    # -- jobs and files ---------------------------------------------------------------------------------------------

    @contextmanager
    def attempt(self, job: str) -> Iterator[bool]:
        """Try to be the only one at a job.

        A restart of the server frees the job while it runs: another worker may then do it too, to the same end, and
        what is published first counts.
        """
        connection, mine = self.patiently(lambda: self._try_lock(f"job {self.study} {job}"))
        try:
            yield mine
        finally:
            connection.close()

    def _try_lock(self, name: str) -> tuple[Connection, bool]:
        """Return a connection, and whether it holds an advisory lock, which ends with it."""
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

    def execute(self, statement: str, **parameters: Any) -> Any:
        """Run a statement, and return the first value of what it gives."""
        from sqlalchemy import text

        with self._engine.begin() as connection:
            found = connection.execute(text(statement), parameters)
            return found.scalar() if found.returns_rows else None


def _key(name: str) -> str:
    return f"softgym codesign {name}"


def _went_away(error: BaseException) -> bool:
    """Tell whether an error is of the connection or of a conflict, so that the same action may succeed later."""
    from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError, PendingRollbackError

    cause = error.__cause__ if type(error).__name__ == "StorageInternalError" else error
    lost = isinstance(cause, DBAPIError) and cause.connection_invalidated
    return lost or isinstance(cause, (OperationalError, InterfaceError, PendingRollbackError))


def _reason(error: BaseException) -> str:
    """First line of what the database said."""
    from sqlalchemy.exc import DBAPIError

    cause = error.__cause__ if type(error).__name__ == "StorageInternalError" and error.__cause__ else error
    text = str(cause.orig if isinstance(cause, DBAPIError) else cause)
    return next(iter(text.strip().splitlines()), type(cause).__name__)
