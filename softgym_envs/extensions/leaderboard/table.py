"""Tabular mode: many bodies of a problem with their scores in one Parquet file, for work without a simulator.

A tabular search chooses among the listed bodies: the body that an optimiser asks for is replaced by the nearest listed
one in the unit box, and that is what the ledger says. Nothing is interpolated.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from softgym_envs.agents.evaluation import evaluate
from softgym_envs.errors import DataError, unknown_name
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem, load_problem
from softgym_envs.extensions.leaderboard.problem import Judge, JudgedScore
from softgym_envs.extensions.leaderboard.rest import LONGEST, outcome, settle, settle_on_fem
from softgym_envs.extensions.leaderboard.scoring import DATA
from softgym_envs.extensions.leaderboard.search import Search
from softgym_envs.extras import require
from softgym_envs.runs import provenance
from softgym_envs.storage import atomic_write, read_npz
from softgym_envs.surrogate.pretrained import ships_weights

if TYPE_CHECKING:
    from softgym_envs.agents.config import EnvironmentConfig
    from softgym_envs.envs.vector_env import SoftRobotVectorEnv

CHUNK = 64
"""Bodies whose episodes run at once."""

FEW = 2
"""How many goals, from the first on, judges with ``_few`` in their names score. They are for accurate finite elements,
which take 35 to 60 CPU s a body on the 12 goals of the finger, and they are compared with ``rest_few``."""

FEWEST_RANKED, MAX_RESAMPLED = 10, 256
"""Smallest number of bodies whose ranking by two judges is compared, and largest whose tau has an interval."""

BEST_SHARE = 0.1
"""Share of the bodies that counts as the best ones when judges are compared: there searches go."""

COLUMNS = ("mean_distance", "mean_effort", "success_rate")
"""What a table holds of each body and judge: means over the search goals. The effort is that of the end for judges at
rest, and the mean over the episode for the others."""


@dataclass(frozen=True)
class Agreement:
    """How two judges agree on bodies.

    Attributes:
        bodies: how many both have scored.
        tau: Kendall's tau of their mean distances; NaN for fewer than three bodies.
        interval: 95 % interval of tau by a bootstrap over the bodies; NaN for fewer than `FEWEST_RANKED` bodies, and
            for more than `MAX_RESAMPLED`, where it is narrower than +-0.1.
        bias: mean of the distances [m] of the second judge minus those of the first.
    """

    bodies: int
    tau: float = np.nan
    interval: tuple[float, float] = (np.nan, np.nan)
    bias: float = np.nan


@dataclass(frozen=True)
class Table:
    """The bodies of a table and their scores.

    Attributes:
        problem: the problem.
        points: bodies in the unit box [-1, 1]^n, shape (bodies, n): the first of a scrambled Sobol sequence.
        values: by judge, `COLUMNS` of each body [SI], shape (bodies, 3); NaN where a judge has not scored a body.
        longest: largest step towards rest, relative to the range of a command, of the judges at rest.
        first: by judge, how many bodies from the beginning it has scored; others were chosen, see `tabulate`.
        samples: by judge and share of the best bodies of `rest` ("1", "0.1"), the places of a sample over their ranks.
    """

    problem: FrozenProblem
    points: np.ndarray
    values: Mapping[str, np.ndarray]
    longest: float = LONGEST
    first: Mapping[str, int] = field(default_factory=dict)
    samples: Mapping[str, Mapping[str, list[int]]] = field(default_factory=dict)

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
        meta = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        if meta.get("hash") != problem.hash:
            raise DataError(f"the table '{path}' is for another version of '{name}'; run: softgym benchmark tabulate")
        columns = {key: table[key].to_numpy().astype(float) for key in table.column_names}
        points = np.stack([columns[f"unit_{key}"] for key in problem.variables], axis=1)
        judges = sorted({key.partition(".")[0] for key in columns if "." in key})
        values = {judge: np.stack([columns[f"{judge}.{key}"] for key in COLUMNS], axis=1) for judge in judges}
        if "first" in meta:
            first = json.loads(meta["first"])
        else:  # a table from before bodies were chosen
            first = {judge: _scored(rows) for judge, rows in values.items()}
        return cls(problem, points, values, float(meta["longest"]), first, json.loads(meta.get("samples", "{}")))

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

    def agreement(self, first: str, second: str, best: float = 1.0) -> Agreement:
        """Compare the mean distances of two judges on the bodies that both have scored.

        With a share ``best`` only that share of the bodies counts, those that the first judge finds best: there
        searches go. Of a judge with a sample over these ranks, see `tabulate`, only the sample counts.
        """
        from scipy.stats import bootstrap, kendalltau

        a, b = self.values[first][:, 0], self.values[second][:, 0]
        both = np.isfinite(a) & np.isfinite(b)
        sample = self.samples.get(second, {}).get(f"{best:g}")
        if sample is not None:
            both &= np.isin(np.arange(len(a)), sample)
        elif best < 1.0 and both.any():
            both &= a <= np.quantile(a[both], best)
        count, pair = int(both.sum()), (a[both], b[both])
        if count < 3:
            return Agreement(count, bias=float(np.mean(pair[1] - pair[0])) if count else np.nan)

        def tau(x: np.ndarray, y: np.ndarray) -> float:
            return float(kendalltau(x, y).statistic)

        interval = (np.nan, np.nan)
        if FEWEST_RANKED <= count <= MAX_RESAMPLED:
            drawn = bootstrap(pair, tau, paired=True, vectorized=False, n_resamples=2000, method="percentile", rng=0)
            interval = float(drawn.confidence_interval.low), float(drawn.confidence_interval.high)
        return Agreement(count, tau(*pair), interval, float(np.mean(pair[1] - pair[0])))


def shipped_tables() -> list[str]:
    """Return the names of the problems with a shipped table."""
    return sorted(path.stem for path in (DATA / "tables").glob("*.parquet"))


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

    def evaluate(self, design: Mapping[str, float], budget: float = 1.0, **training: Path | None) -> JudgedScore:
        """Return the score of the nearest listed body, on all goals."""
        definition = self.problem.definition
        design = definition.checked(design)
        point = np.array([float(definition.optimised[name].to_unit(value)) for name, value in design.items()])
        index = int(self.table.nearest(point[None], str(self.judge))[0])
        value = float(self.table.values[str(self.judge)][index, 0])
        steps = len(self.problem.goals["search"]) * definition.episode_steps
        row = JudgedScore(
            str(self.judge),
            design=self.problem.design(self.table.points[index]),
            values={definition.objective: value},
            scores=[definition.primary.score(value)],
            environment_steps=steps,
        )
        self.ledger.append(row)
        return row


@dataclass(frozen=True)
class Tabulation:
    """How bodies of a problem are scored for a table: each judge by one function of points (k, n) to rows (k, 3).

    Args:
        problem: a problem with the objective ``mean_distance``, on a batched surrogate.
        longest: largest step towards rest, see `softgym_envs.extensions.leaderboard.rest`.
        goal_set: name of the goals.
        goal_count: how many of them count, from the first on; default all.

    Raises:
        ValueError: for a problem that has no such table.
    """

    problem: FrozenProblem
    longest: float = LONGEST
    goal_set: str = "search"
    goal_count: int | None = None

    def __post_init__(self) -> None:
        definition = self.problem.definition
        learned = definition.environment.batched and definition.environment.backend == "surrogate"
        if definition.objective != "mean_distance" or not learned:
            raise ValueError(
                f"problem '{self.problem.name}' cannot be tabulated: "
                "it needs the objective mean_distance on a surrogate"
            )

    @property
    def goals(self) -> np.ndarray:
        """The goals [m], shape (g, p, 3)."""
        return self.problem.goals[self.goal_set][: self.goal_count]

    @cached_property
    def few(self) -> Tabulation:
        """The same on the first `FEW` goals."""
        return replace(self, goal_count=FEW)

    def designs(self, points: np.ndarray) -> list[dict[str, float]]:
        """Return the complete designs [SI] of points (k, n) of the unit box."""
        return [self.problem.definition.body(self.problem.design(point))[0] for point in points]

    def episodes(self, agent: str, points: np.ndarray) -> np.ndarray:
        """Return `COLUMNS` of whole episodes on the learned model, all bodies at once."""
        designs = [design for design in self.designs(points) for _ in self.goals]
        tiled = np.tile(self.goals, (len(points), 1, 1))
        found = evaluate(agent, self.problem.definition.environment, tiled, design=designs)
        columns = np.stack([found.distances, found.efforts, found.successes.astype(float)], axis=1)
        return columns.reshape(len(points), len(self.goals), -1).mean(axis=1)

    def environment(self, mesh: str | None) -> EnvironmentConfig:
        """Return the environment of the problem on a mesh of its robot; None: the mesh of the problem."""
        environment = self.problem.definition.environment
        if mesh is None:
            return environment
        return environment.model_copy(update={"robot_options": {**environment.robot_options, "mesh": mesh}})

    def at_rest(self, mesh: str | None, points: np.ndarray) -> np.ndarray:
        """Return `COLUMNS` where the inverse QP comes to rest on the learned model of a mesh."""
        return self._at_rest(mesh, points)[0]

    def _at_rest(self, mesh: str | None, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `COLUMNS` of each body, and the last commands, shape (k, g, n_a)."""
        count, goals = len(points), self.goals
        tiled = np.tile(goals, (count, 1, 1))
        made = self.environment(mesh).make_vec(len(tiled), sample_design=False)
        env = cast("SoftRobotVectorEnv", made.unwrapped)
        try:
            designs = [design for design in self.designs(points) for _ in goals]
            env.reset(seed=0, options={"design": designs, "goal": tiled})
            command, _ = settle(env, tiled[:, 0], self.longest)
            rows = outcome(env, tiled[:, 0])
        finally:
            made.close()
        return rows.reshape(count, len(goals), -1).mean(axis=1), command.reshape(count, len(goals), -1)

    def trained(self, points: np.ndarray) -> np.ndarray:
        """Return `COLUMNS` of policies that are trained anew for each body, on the learned model."""
        every = {"secondary_objectives": COLUMNS[1:]}
        evaluator = self.problem.evaluator("search")
        evaluator = replace(evaluator, problem=evaluator.problem.model_copy(update=every))
        rows = [evaluator(self.problem.design(point), "trained").values for point in points]
        return np.array([[values.get(name, np.nan) for name in COLUMNS] for values in rows])

    def fem(self, mesh: str | None, points: np.ndarray) -> np.ndarray:
        """Return `COLUMNS` where the inverse QP comes to rest on finite elements of a mesh.

        Bodies begin with the commands that the learned model of this mesh rests at; without one, with those of the
        problem's.
        """
        environment = self.environment(mesh)
        robot = self.problem.definition.model_copy(update={"environment": environment}).robot
        _, commands = self._at_rest(mesh if ships_weights(robot) else None, points)
        success = environment.make_task(robot).success_distance
        rows = [
            settle_on_fem(robot, design, self.goals[:, 0], command, success, self.longest).mean(axis=0)
            for design, command in zip(self.designs(points), commands, strict=True)
        ]
        return np.array(rows)


@dataclass(frozen=True)
class TableJudge:
    """A judge of a table: what it is, the bodies that it scores at once, and how."""

    about: str
    chunk: int
    score: Callable[[Tabulation, np.ndarray], np.ndarray]


TABLE_JUDGES: dict[str, TableJudge] = {
    "rest": TableJudge("inverse QP, at rest on the learned model", 256, lambda t, points: t.at_rest(None, points)),
    "rest_accurate": TableJudge(
        "inverse QP, at rest on the learned model of the accurate mesh",
        256,
        lambda t, points: t.at_rest("accurate", points),
    ),
    "qp": TableJudge("inverse QP, whole episodes", CHUNK, lambda t, points: t.episodes("qp", points)),
    "shared": TableJudge(
        "shared policy, whole episodes",
        CHUNK,
        lambda t, points: t.episodes(str(t.problem.definition.policy), points),
    ),
    "trained": TableJudge("a policy trained for each body, whole episodes", 1, Tabulation.trained),
    "fem": TableJudge("inverse QP, at rest on finite elements", 8, lambda t, points: t.fem(None, points)),
    "fem_accurate": TableJudge(
        "inverse QP, at rest on the accurate mesh", 1, lambda t, points: t.fem("accurate", points)
    ),
    "rest_few": TableJudge(f"as `rest`, on the first {FEW} goals", 1, lambda t, points: t.few.at_rest(None, points)),
    "rest_accurate_few": TableJudge(
        f"as `rest_accurate`, on the first {FEW} goals", 1, lambda t, points: t.few.at_rest("accurate", points)
    ),
    "fem_accurate_few": TableJudge(
        f"as `fem_accurate`, on the first {FEW} goals", 1, lambda t, points: t.few.fem("accurate", points)
    ),
}
"""Judges of tables by name. Bodies are chunked so that an interrupted computation resumes after each chunk."""


def tabulate(
    name: str,
    counts: Mapping[str, int],
    folder: Path,
    output: Path | None = None,
    longest: float = LONGEST,
    best: Mapping[str, int] | None = None,
    ranked: Mapping[str, int] | None = None,
) -> Path:
    """Score bodies of a problem and write the table; an interrupted call continues where it stopped.

    A table that is there already is extended: its scores are kept, and only missing ones are computed.

    Args:
        name: a problem with the objective ``mean_distance``, on a batched surrogate.
        counts: by judge of `TABLE_JUDGES`, how many bodies it scores: the first ones of the sequence.
        folder: where the parts are kept.
        output: the Parquet file; default the shipped one.
        longest: largest step towards rest, relative to the range of a command.
        best: by judge, how many of the best bodies of each judge at rest on a learned model it scores besides: there
            searches go, and few bodies are enough for a judge that takes minutes for each.
        ranked: by judge, how many bodies it scores besides of a sample over the ranks of ``rest``, and as many of a
            sample over the best `BEST_SHARE` of these ranks: what a judge that is slow says about the ranking. A
            longer sample begins with the shorter one.

    Raises:
        ValueError: for a problem that has no such table, an unknown judge, or ``ranked`` without bodies of ``rest``.
    """
    require("benchmark")
    problem = load_problem(name)
    tabulation = Tabulation(problem, longest)
    best, ranked = best or {}, ranked or {}
    for judge in (*counts, *best, *ranked):
        if judge not in TABLE_JUDGES or (judge == "shared" and problem.definition.policy is None):
            raise ValueError(f"problem '{name}': {unknown_name('judge of tables', judge, TABLE_JUDGES)}")
    path = output or DATA / "tables" / f"{name}.parquet"
    known, first, samples = _extendable(name, path, longest)
    bodies = max([*counts.values(), *(len(table) for table in known.values())])
    points = _points(len(problem.variables), bodies)
    values = {
        judge: np.full((bodies, len(COLUMNS)), np.nan) for judge in dict.fromkeys([*known, *counts, *best, *ranked])
    }
    for judge, table in known.items():
        values[judge][: len(table)] = table
    for judge, count in counts.items():
        chunk, done = TABLE_JUDGES[judge].chunk, first.get(judge, 0)
        first[judge] = max(done, count)
        for start in range(done - done % chunk, count, chunk):
            rows = slice(start, min(start + chunk, count))
            if rows.stop > done:
                values[judge][rows] = tabulated(tabulation, judge, points[rows], folder, start)
    chosen = [(judge, place) for judge, count in best.items() for place in _leading(values, count)]
    for judge, count in ranked.items():
        samples[judge] = _samples(values, first, count)
        chosen += [(judge, place) for places in zip(*samples[judge].values(), strict=True) for place in places]
    for judge, place in chosen:
        if np.isnan(values[judge][place, 0]):
            values[judge][place] = tabulated(tabulation, judge, points[place : place + 1], folder, place)[0]
    return _write(Table(problem, points, values, longest, first, samples), path)


def _samples(values: Mapping[str, np.ndarray], first: Mapping[str, int], count: int) -> dict[str, list[int]]:
    """Return places of a random sample over the ranks of ``rest``, and of one over its best bodies.

    Ranks are those among the bodies that all judges at rest on a learned model have scored. They follow a scrambled
    Sobol sequence, so that they are spread evenly, and a longer sample begins with the shorter one.

    Raises:
        ValueError: if ``rest`` has not scored so many bodies.
    """
    from scipy.stats import qmc

    scored = min((first[judge] for judge in ("rest", "rest_accurate") if judge in first), default=0)
    if "rest" not in first or BEST_SHARE * scored < count:
        raise ValueError(f"a sample of {count} of the best bodies needs {round(count / BEST_SHARE)} bodies of 'rest'")
    order = np.argsort(values["rest"][:scored, 0])
    drawn = qmc.Sobol(1, rng=np.random.default_rng(0)).random(1 << (count - 1).bit_length())[:count, 0]
    return {f"{share:g}": [int(order[int(part * share * scored)]) for part in drawn] for share in (1.0, BEST_SHARE)}


def _leading(values: Mapping[str, np.ndarray], count: int) -> list[int]:
    """Return the places of the best bodies of each judge at rest on a learned model."""
    judges = [judge for judge in ("rest", "rest_accurate") if judge in values]
    return sorted({int(place) for judge in judges for place in np.argsort(values[judge][:, 0])[:count]})


def _extendable(
    name: str, path: Path, longest: float
) -> tuple[dict[str, np.ndarray], dict[str, int], dict[str, Mapping[str, list[int]]]]:
    """Return values, `Table.first` and `Table.samples` of a table that is there.

    All are empty if it is for another version or another step.
    """
    if not path.is_file():
        return {}, {}, {}
    try:
        found = Table.read(name, path)
    except DataError:
        return {}, {}, {}
    same = found.longest == longest and np.allclose(found.points, _points(found.points.shape[1], len(found)), atol=1e-6)
    return (dict(found.values), dict(found.first), dict(found.samples)) if same else ({}, {}, {})


def _scored(values: np.ndarray) -> int:
    """Return how many bodies a judge has scored: up to the last one with a value."""
    rows = np.flatnonzero(np.isfinite(values[:, 0]))
    return int(rows[-1]) + 1 if len(rows) else 0


def _points(dimension: int, count: int) -> np.ndarray:
    from scipy.stats import qmc

    whole = 1 << (count - 1).bit_length()  # a Sobol sequence is balanced in powers of two
    return np.round(2.0 * qmc.Sobol(dimension, rng=np.random.default_rng(0)).random(whole)[:count] - 1.0, 6)


def tabulated(
    tabulation: Tabulation, judge: str, points: np.ndarray, folder: Path, start: int | None = None
) -> np.ndarray:
    """Return `COLUMNS` of points (k, n) of the unit box under a judge; computed once and kept in a folder.

    Args:
        tabulation: how bodies are scored.
        judge: key of `TABLE_JUDGES`.
        points: points of the unit box, shape (k, n).
        folder: where results are kept.
        start: place of the first point in the sequence of a table, which names the file; default a hash names it.
    """
    problem = tabulation.problem
    way = judge if judge in ("qp", "shared", "trained") else f"{judge}-{tabulation.longest:g}"
    place = sha256(np.round(points, 6).tobytes()).hexdigest()[:16] if start is None else f"{start:07d}"
    path = folder / "tables" / problem.name / problem.hash[:12] / f"{way}-{place}-{len(points)}.npz"
    if path.is_file():
        return read_npz(path, ("values",))["values"]
    values = TABLE_JUDGES[judge].score(tabulation, points)
    with atomic_write(path) as stream:
        np.savez(stream, values=values)
    return values


def _write(found: Table, path: Path) -> Path:
    import pyarrow
    from pyarrow import parquet

    problem, points, values = found.problem, found.points, found.values
    columns = {f"unit_{name}": points[:, i].astype(np.float32) for i, name in enumerate(problem.variables)}
    for judge, table in values.items():
        if np.isfinite(table).any():
            columns |= {f"{judge}.{key}": table[:, i].astype(np.float32) for i, key in enumerate(COLUMNS)}
    meta = {
        "problem": problem.name,
        "hash": problem.hash,
        "columns": json.dumps(list(columns)),
        "longest": f"{found.longest:g}",
        "first": json.dumps(dict(found.first)),
        "samples": json.dumps(dict(found.samples)),
        "commit": str(provenance()["commit"]),
    }
    with atomic_write(path) as stream:
        parquet.write_table(pyarrow.table(columns).replace_schema_metadata(meta), stream, compression="zstd")
    return path
