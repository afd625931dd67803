"""Optimisers of other packages than Optuna: BoTorch, quality-diversity (pyribs) and SMAC3."""

from __future__ import annotations

import shutil
import tempfile
import warnings
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.codesign.sampling import construct
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem
from softgym_envs.extensions.leaderboard.problem import JudgedScore
from softgym_envs.extensions.leaderboard.search import OptunaOptimiser
from softgym_envs.extras import require

CELLS = 6
"""Cells of the archive along each of its two measures."""

BATCH = 4
"""Bodies in a generation of a quality-diversity method."""

STARTUP = 8
"""Bodies before a model of the scores proposes any, as for the other methods with a model."""


class BoTorchOptimiser(OptunaOptimiser):
    """BoTorch's log-expected improvement (of the hypervolume, with several objectives), as a sampler of Optuna.

    Args:
        problem: the problem.
        seed: of the sampler.
    """

    def __init__(self, problem: FrozenProblem, seed: int) -> None:
        require("optimisers")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # importing BoTorch calls torch.jit.script
            from optuna_integration import BoTorchSampler
        super().__init__(problem, construct(BoTorchSampler, {"n_startup_trials": STARTUP, "seed": seed}))

    def ask(self) -> Mapping[str, float]:
        """Return the body to score next."""
        from botorch.exceptions.warnings import BotorchWarning
        from linear_operator.utils.warnings import NumericalWarning
        from optuna.exceptions import ExperimentalWarning

        with warnings.catch_warnings():
            # Equal bodies make the covariance nearly singular, which both packages handle and say so.
            for category in (BotorchWarning, NumericalWarning, ExperimentalWarning):
                warnings.simplefilter("ignore", category)
            return super().ask()


CHALLENGERS = 1_000
"""Bodies among which SMAC3 looks for the most promising one."""

MAX_LEAVES = 1_024
"""Largest number of leaves in a tree of SMAC3, more than a search has bodies."""


class QualityDiversityOptimiser:
    """Quality-diversity by pyribs: the best body of each cell of an archive over the shape of the body.

    The measures are the first two variables of the problem. What is submitted is the best body of all, as for other
    methods; the archive keeps the search from concentrating on it.

    Args:
        problem: the problem, with one objective and two variables or more.
        seed: of the emitter.
        emitter: ``"map_elites"``, Gaussian changes of bodies of the archive (Mouret and Clune 2015, arXiv:1504.04909),
            or ``"cma_me"``, CMA-ES that ranks bodies by how much they improve the archive (Fontaine et al. 2020,
            arXiv:1912.02400).
    """

    def __init__(self, problem: FrozenProblem, seed: int, emitter: str) -> None:
        require("optimisers")
        from ribs.archives import GridArchive
        from ribs.emitters import EvolutionStrategyEmitter, GaussianEmitter
        from ribs.schedulers import Scheduler

        self._problem, size = problem, len(problem.variables)
        archive = GridArchive(solution_dim=size, dims=[CELLS, CELLS], ranges=[(-1.0, 1.0)] * 2, seed=seed)
        shared: dict[str, Any] = {"bounds": [(-1.0, 1.0)] * size, "batch_size": BATCH, "seed": seed}
        made: Any
        if emitter == "cma_me":
            made = EvolutionStrategyEmitter(archive, x0=np.zeros(size), sigma0=0.5, ranker="2imp", **shared)
        else:
            first = np.random.default_rng(seed).uniform(-1.0, 1.0, (STARTUP, size))
            made = GaussianEmitter(archive, sigma=0.3, initial_solutions=first, **shared)
        self._scheduler = Scheduler(archive, [made])
        self._waiting: list[np.ndarray] = []
        self._told: list[tuple[float, np.ndarray]] = []

    def ask(self) -> Mapping[str, float]:
        """Return the next body of the generation, or the first one of a new generation."""
        if not self._waiting:
            self._waiting = list(self._scheduler.ask())
        return self._problem.design(self._waiting[0])

    def tell(self, score: JudgedScore) -> None:
        """Learn the outcome; an infeasible body counts as the worst of its generation."""
        self._told.append((score.score, self._waiting.pop(0)))
        if self._waiting:
            return
        values = np.array([value for value, _ in self._told])
        if np.isfinite(values).any():
            values = np.where(np.isfinite(values), values, values[np.isfinite(values)].min())
        else:
            values = np.full_like(values, -1e9)
        self._scheduler.tell(values, np.array([point[:2] for _, point in self._told]))
        self._told = []


class SmacOptimiser:
    """SMAC3 with a random forest (Lindauer et al. 2022, JMLR 23, 54).

    Args:
        problem: the problem, with one objective.
        seed: of SMAC.
    """

    def __init__(self, problem: FrozenProblem, seed: int) -> None:
        require("optimisers")
        from ConfigSpace import ConfigurationSpace, Float
        from smac import HyperparameterOptimizationFacade, Scenario
        from smac.model.random_forest.random_forest import RandomForest

        self._problem = problem
        space = ConfigurationSpace(seed=seed)
        space.add([Float(f"x{i}", (-1.0, 1.0)) for i in range(len(problem.variables))])
        folder = tempfile.mkdtemp()  # for the history that SMAC writes
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        facade = HyperparameterOptimizationFacade
        scenario = Scenario(space, output_directory=Path(folder), deterministic=True, n_trials=1_000_000, seed=seed)
        self._smac = facade(
            scenario,
            target_function=lambda config, seed=0: 0.0,
            initial_design=facade.get_initial_design(scenario, n_configs=STARTUP),
            intensifier=facade.get_intensifier(scenario, max_config_calls=1),
            config_selector=facade.get_config_selector(scenario, retrain_after=1),
            # The forest of the facade but for its limit of leaves: reserving 2^20 takes a CPU second for each fit.
            model=RandomForest(
                space,
                n_trees=10,
                ratio_features=1.0,
                min_samples_split=2,
                min_samples_leaf=1,
                max_leaf_nodes=MAX_LEAVES,
                log_y=True,
                n_jobs=1,
                seed=seed,
            ),
            acquisition_maximizer=facade.get_acquisition_maximizer(scenario, challengers=CHALLENGERS),
            logging_level=False,
            overwrite=True,
        )
        self._trial: Any = None
        self._worst = 0.0

    def ask(self) -> Mapping[str, float]:
        """Return the body to score next."""
        self._trial = self._smac.ask()
        values = dict(self._trial.config)
        return self._problem.design([values[f"x{i}"] for i in range(len(values))])

    def tell(self, score: JudgedScore) -> None:
        """Learn the outcome; an infeasible body costs as much as the worst one so far."""
        from smac.runhistory.dataclasses import TrialValue

        # A crashed run has an infinite cost, which the forest on logarithms of costs cannot take.
        cost = -score.score if score.feasible else self._worst
        self._worst = max(self._worst, cost)
        self._smac.tell(self._trial, TrialValue(cost=cost), save=False)
