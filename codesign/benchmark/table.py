"""Tabular mode: many bodies of a problem with their scores in one Parquet file, for work without a simulator.

A tabular search chooses among the listed bodies: the body that an optimiser asks for is replaced by the nearest listed
one in the unit box, and that is what the ledger says. Nothing is interpolated.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.residual import BatchQP
from softgym_envs.codesign.benchmark.frozen import FrozenProblem, load_problem
from softgym_envs.codesign.benchmark.problem import Judge, Score
from softgym_envs.codesign.benchmark.scoring import DATA
from softgym_envs.codesign.benchmark.search import Search
from softgym_envs.errors import DataError
from softgym_envs.extras import require
from softgym_envs.storage import atomic_write, read_npz

CHUNK = 64
"""Bodies that run at once, and after which an interrupted computation resumes."""

COLUMNS = ("mean_distance", "mean_effort", "success_rate")


@dataclass(frozen=True)
class Table:
    """The bodies of a table and their scores.

    Attributes:
        problem: the problem.
        points: bodies in the unit box [-1, 1]^n, shape (bodies, n): the first of a scrambled Sobol sequence.
        values: by judge, `COLUMNS` of each body [SI], shape (bodies, 3); NaN where a judge has not scored a body.
    """

    problem: FrozenProblem
    points: np.ndarray
    values: Mapping[str, np.ndarray]

    @classmethod
    def read(cls, name: str, path: Path | None = None) -> Table:
        """Return the table of a problem; default the shipped one.

        Raises:
            DataError: if there is none, it is damaged, or it is for another version of the problem.
        """
        require("benchmark")
        from pyarrow import ArrowException, parquet

        path = path or DATA / "tables" / f"{name}.parquet"
        problem = load_problem(name)
        try:
            table = parquet.read_table(path)
        except (OSError, ArrowException) as error:
            raise DataError(f"the table '{path}' cannot be read: {error}") from None
        stored = (table.schema.metadata or {}).get(b"hash", b"").decode()
        if stored != problem.hash:
            raise DataError(f"the table '{path}' is for another version of '{name}'; run: softgym benchmark tabulate")
        columns = {key: table[key].to_numpy().astype(float) for key in table.column_names}
        points = np.stack([columns[f"unit_{key}"] for key in problem.variables], axis=1)
        judges = sorted({key.partition(".")[0] for key in columns if "." in key})
        return cls(
            problem,
            points,
            {judge: np.stack([columns[f"{judge}.{key}"] for key in COLUMNS], axis=1) for judge in judges},
        )

    def __len__(self) -> int:
        """Number of bodies."""
        return len(self.points)

    @cached_property
    def _trees(self) -> dict[str, tuple]:
        """For each judge, a tree of the bodies that it has scored, and their indices."""
        from scipy.spatial import KDTree

        known = {judge: np.flatnonzero(np.isfinite(values[:, 0])) for judge, values in self.values.items()}
        return {judge: (KDTree(self.points[rows]), rows) for judge, rows in known.items()}

    def nearest(self, points: np.ndarray, judge: str) -> np.ndarray:
        """Return the index of the nearest body that a judge has scored, for points (k, n) of the unit box."""
        tree, rows = self._trees[judge]
        return rows[tree.query(np.asarray(points, dtype=float))[1]]

    def best(self, judge: str) -> float:
        """Return the best score of a listed body under a judge; larger is better."""
        return self.problem.definition.primary.score(float(np.nanmin(self.values[judge][:, 0])))

    def lookup(self, points: np.ndarray, judge: str) -> np.ndarray:
        """Return `COLUMNS` [SI] of the nearest listed bodies, shape (k, 3), for points (k, n) of the unit box."""
        return self.values[judge][self.nearest(points, judge)]


class TableSearch(Search):
    """A search whose scores come from a table; it costs the environment steps of the real evaluations, and no time."""

    table: Table

    @classmethod
    def on(cls, table: Table, level: str, judge: Judge) -> TableSearch:
        """Return a search on a table."""
        if judge not in table.values:
            raise ValueError(f"the table has no judge '{judge}'; allowed: {', '.join(table.values)}")
        search = cls(table.problem, level, judge)
        search.table = table
        return search

    def evaluate(self, design: Mapping[str, float], budget: float = 1.0) -> Score:
        """Return the score of the nearest listed body, on all goals."""
        definition = self.problem.definition
        design = definition.checked(design)
        point = np.array([float(definition.optimised[name].to_unit(value)) for name, value in design.items()])
        index = int(self.table.nearest(point[None], str(self.judge))[0])
        value = float(self.table.values[str(self.judge)][index, 0])
        steps = len(self.problem.goals["search"]) * definition.episode_steps
        row = Score(
            self.problem.design(self.table.points[index]),
            str(self.judge),
            values={definition.objective: value},
            scores=[definition.primary.score(value)],
            environment_steps=steps,
        )
        self.ledger.append(row)
        return row


def tabulate(name: str, bodies: int, qp_bodies: int, folder: Path, output: Path | None = None) -> Path:
    """Score bodies of a problem and write the table; an interrupted call continues where it stopped.

    Args:
        name: a problem with the objective ``mean_distance``, on a batched surrogate.
        bodies: number of bodies, scored by the shared policy.
        qp_bodies: number of these, the first ones, that the inverse QP scores too (far slower).
        folder: where the parts are kept.
        output: the Parquet file; default the shipped one.

    Raises:
        ValueError: for a problem that has no such table.
    """
    require("benchmark")
    problem = load_problem(name)
    definition = problem.definition
    learned = definition.environment.batched and definition.environment.backend == "surrogate"
    if definition.objective != "mean_distance" or not learned:
        raise ValueError(f"problem '{name}' cannot be tabulated: it needs the objective mean_distance on a surrogate")
    points = _points(len(problem.variables), bodies)
    values: dict[str, np.ndarray] = {}
    counts = {"shared": bodies if definition.policy else 0, "qp": qp_bodies}
    for judge, count in counts.items():
        values[judge] = np.full((bodies, len(COLUMNS)), np.nan)
        for start in range(0, count, CHUNK):
            rows = slice(start, min(start + CHUNK, count))
            values[judge][rows] = _chunk(problem, judge, points[rows], start, folder)
    return _write(problem, points, values, output or DATA / "tables" / f"{name}.parquet")


def _points(dimension: int, count: int) -> np.ndarray:
    from scipy.stats import qmc

    whole = 1 << (count - 1).bit_length()  # a Sobol sequence is balanced in powers of two
    return np.round(2.0 * qmc.Sobol(dimension, rng=np.random.default_rng(0)).random(whole)[:count] - 1.0, 6)


def _chunk(problem: FrozenProblem, judge: str, points: np.ndarray, start: int, folder: Path) -> np.ndarray:
    path = folder / "tables" / problem.name / problem.hash[:12] / f"{judge}-{start:07d}-{len(points)}.npz"
    if path.is_file():
        return read_npz(path, ("values",))["values"]
    definition, goals = problem.definition, problem.goals["search"]
    designs = [definition.body(problem.design(point))[0] for point in points for _ in goals]
    tiled = np.tile(goals, (len(points), 1, 1))
    if judge == "qp":
        columns = _qp(definition.environment, tiled, designs)
    else:
        found = evaluate(str(definition.policy), definition.environment, tiled, design=designs)
        columns = np.stack([found.distances, found.efforts, found.successes.astype(float)], axis=1)
    values = columns.reshape(len(points), len(goals), -1).mean(axis=1)
    with atomic_write(path) as stream:
        np.savez(stream, values=values)
    return values


def _qp(environment: EnvironmentConfig, goals: np.ndarray, designs: list[dict[str, float]]) -> np.ndarray:
    """Return final distance, mean effort and success of each episode under the inverse QP, shape (n, 3)."""
    env = environment.make_vec(len(goals), sample_design=False)
    try:
        env.reset(seed=0, options={"design": designs, "goal": goals})
        control, effort, count = BatchQP(env.unwrapped), np.zeros(len(goals)), 0  # type: ignore[arg-type]
        while True:
            *_, truncated, info = env.step(control())
            last = info.get("final_info", info)
            effort += np.abs(last["effort"]).mean(axis=1)
            count += 1
            if truncated.all():
                success = last["is_success"] & last["converged"]
                return np.stack([last["distance"], effort / count, success.astype(float)], axis=1)
    finally:
        env.close()


def _write(problem: FrozenProblem, points: np.ndarray, values: Mapping[str, np.ndarray], path: Path) -> Path:
    import pyarrow
    from pyarrow import parquet

    columns = {f"unit_{name}": points[:, i].astype(np.float32) for i, name in enumerate(problem.variables)}
    for judge, table in values.items():
        if np.isfinite(table).any():
            columns |= {f"{judge}.{key}": table[:, i].astype(np.float32) for i, key in enumerate(COLUMNS)}
    meta = {"problem": problem.name, "hash": problem.hash, "columns": json.dumps(list(columns))}
    found = pyarrow.table(columns).replace_schema_metadata(meta)
    with atomic_write(path) as stream:
        parquet.write_table(found, stream, compression="zstd")
    return path
