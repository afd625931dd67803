"""Learners compared: CPU seconds to 90 and 95 % of unseen goals on the surrogate, and success of the policies on FEM.

    python -m benchmarks.learners results/learners finger_reach:analytic finger_reach:sac

trains the configuration of each named task and learner (default: all that there are) with three seeds, the cheapest
learners first. On paths, the return as a share of the inverse QP's takes the place of the share of goals. Training
stops after `BUDGET` CPU seconds of learning. Each training is a row of its own in a file of its own, and rows that
exist are not computed again. The rows that this repository keeps are in ``benchmarks/data/learners.json``;
``softgym bench learners`` shows them.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from softgym_envs.config import load_config, provenance
from softgym_envs.storage import write_json

KEPT = Path(__file__).parent / "data" / "learners.json"
CONFIGS = Path(__file__).parent.parent / "configs" / "agents"
TASKS = (
    "finger_reach",
    "diamond_reach",
    "trunk_reach",
    "cable_trunk_reach",
    "finger_track",
    "diamond_track",
    "trunk_track",
    "cable_trunk_track",
    "finger_reach_designs",
    "diamond_reach_designs",
    "trunk_reach_designs",
    "cable_trunk_reach_designs",
)
"""Names of the configurations of SAC; those of another learner have its name appended."""
REPORTS = {"analytic": 6_400, "cloning": 3_200, "ppo": 12_800, "sac": 1_600}
"""Learners, and environment steps between evaluations on single goals; these do not count as learning.

Learners begin new episodes after each evaluation, and an episode on a path is longer than these steps allow. There the
configuration's own number holds.
"""
SEEDS = (0, 1, 2)
GOALS, FEM_GOALS = 200, 50
"""Unseen goals of each evaluation during training, and others for the policy that is kept, on FEM."""
SCORES = {False: "goals reached on {} [%]", True: "return on {} [% of the QP's]"}
"""What the results of a task call its score on a backend, by whether the goal moves along a path."""
BUDGET = 150.0
"""CPU seconds of learning after which a training is stopped."""


@dataclass(frozen=True)
class LearnerRow:
    """One training.

    Attributes:
        task: name of the configuration of SAC.
        learner: name of the learner.
        seed: seed of the training.
        seconds_90: CPU seconds of learning until the score is 0.9; None if it never is.
        seconds_95: the same for 0.95.
        seconds: CPU seconds of learning of the whole training.
        steps: environment steps of the whole training.
        score: of the kept policy on the surrogate: share of the goals that it reaches; on paths, its return as a share
            of the inverse QP's.
        fem_score: the same for other goals, on FEM.
        stopped: whether the training was stopped by the budget.
        commit: of the code.
    """

    task: str
    learner: str
    seed: int
    seconds_90: float | None
    seconds_95: float | None
    seconds: float
    steps: int
    score: float
    fem_score: float
    stopped: bool
    commit: str


def config_path(task: str, learner: str) -> Path:
    """Return the configuration of a task for a learner, which need not exist."""
    return CONFIGS / f"{task if learner == 'sac' else f'{task}_{learner}'}.yaml"


def measure(task: str, learner: str, seed: int, commit: str, folder: Path) -> LearnerRow:
    """Train and evaluate one policy."""
    from softgym_envs.agents.config import TrainConfig
    from softgym_envs.agents.evaluation import Evaluation, evaluate
    from softgym_envs.agents.policy import Policy
    from softgym_envs.agents.sweep import unseen_goals
    from softgym_envs.agents.training import train

    config = load_config(config_path(task, learner), TrainConfig)
    path_task = config.environment.task_class.horizon > 1
    goals_each = 1 if path_task else GOALS
    report_every = config.report_every if path_task else REPORTS[learner]
    update = {"seed": seed, "evaluation_episodes": goals_each, "report_every": report_every}
    config = config.model_copy(update=update)
    place = folder / f"{task}_{learner}_{seed}"

    def spent(step: int, outcome: Evaluation) -> bool:
        with (place / "curve.csv").open() as stream:
            return float(list(csv.DictReader(stream))[-1]["learning_seconds"]) >= BUDGET

    policy = train(config, place, report=spent, progress=False)
    card = Policy(policy).card
    curve = card["curve"]
    designs, goals = unseen_goals(config.environment, 1 if path_task else FEM_GOALS)

    def score(backend: str) -> float:
        environment = config.environment.on(backend)
        outcome = evaluate(policy, environment, goals, design=designs)
        if not path_task:
            return outcome.success_rate
        return outcome.mean_return / evaluate("qp", environment, goals, design=designs).mean_return

    best = max(curve, key=lambda point: point["mean_return"])
    if path_task:
        scale = score("surrogate") / best["mean_return"]
        scores = [point["mean_return"] * scale for point in curve]
    else:
        scores = [point["success_rate"] for point in curve]
    seconds = [
        next((point["learning_seconds"] for point, value in zip(curve, scores, strict=True) if value >= share), None)
        for share in (0.9, 0.95)
    ]
    return LearnerRow(
        task,
        learner,
        seed,
        *seconds,
        curve[-1]["learning_seconds"],
        curve[-1]["step"],
        scores[curve.index(best)],
        score("fem"),
        card["stopped_early"],
        commit,
    )


def main(folder: Path, chosen: list[str]) -> None:
    """Compute the rows that are missing, each in a process of its own, and write them to the kept file."""
    every = [[task, learner] for learner in REPORTS for task in TASKS if config_path(task, learner).exists()]
    pairs = [name.split(":") for name in chosen] or every
    commit = str(provenance()["commit"])  # of the code, before the first row changes the kept file
    for seed in SEEDS:
        for task, learner in pairs:
            path = folder / f"{task}_{learner}_{seed}.json"
            if not path.exists():
                subprocess.run(
                    [sys.executable, "-m", "benchmarks.learners", "--row", task, learner, str(seed), commit, str(path)],
                    check=True,
                )
                print(f"{path.name}: {json.loads(path.read_text())}", flush=True)
            collect(folder)


def collect(folder: Path) -> None:
    """Merge the rows of a folder into the kept ones."""
    kept = {(row.task, row.learner, row.seed): row for row in rows()}
    for path in folder.glob("*.json"):
        row = LearnerRow(**json.loads(path.read_text()))
        kept[row.task, row.learner, row.seed] = row
    order = {name: k for k, name in enumerate((*TASKS, *REPORTS))}
    ordered = sorted(kept.values(), key=lambda row: (order[row.task], order[row.learner], row.seed))
    write_json(KEPT, [asdict(row) for row in ordered])


def rows() -> list[LearnerRow]:
    """Return the kept rows."""
    return [LearnerRow(**row) for row in json.loads(KEPT.read_text())] if KEPT.exists() else []


def learners() -> dict[str, object]:
    """CPU seconds to 90 and 95 % of unseen goals, and success on FEM: for each task and learner, a list over seeds.

    On paths it is the return as a share of the inverse QP's. A time is a number, ``"never"``, or, for a training that
    the budget stopped, ``"> 150"``.
    """
    kept = rows()
    result: dict[str, object] = {}
    for task in TASKS:
        for learner in REPORTS:
            if not config_path(task, learner).exists():
                continue
            found = [row for row in kept if (row.task, row.learner) == (task, learner)]
            if not found:
                result[f"{task}, {learner}"] = "not run"
                continue
            score = SCORES["_track" in task]
            result |= {
                f"{task}, {learner}: CPU seconds to 90 %": [_time(row, row.seconds_90) for row in found],
                f"{task}, {learner}: CPU seconds to 95 %": [_time(row, row.seconds_95) for row in found],
                f"{task}, {learner}: CPU seconds of the training": [row.seconds for row in found],
                f"{task}, {learner}: {score.format('the surrogate')}": [100 * row.score for row in found],
                f"{task}, {learner}: {score.format('FEM')}": [100 * row.fem_score for row in found],
            }
    return result


def _time(row: LearnerRow, seconds: float | None) -> float | str:
    if seconds is not None:
        return seconds
    return f"> {BUDGET:g}" if row.stopped else "never"


def spread(values: list[float | str], form: str = ".3g") -> str:
    """Write the values of the seeds: median (smallest to largest); texts such as "never" count as infinite."""
    known = sorted(values, key=lambda value: np.inf if isinstance(value, str) else value)

    def text(value: float | str) -> str:
        return value if isinstance(value, str) else f"{value:{form}}"

    exact = len(known) % 2 == 1 or isinstance(known[-1], str)
    middle = text(known[(len(known) - 1) // 2] if exact else float(np.median(known)))
    return middle if known[0] == known[-1] else f"{middle} ({text(known[0])} to {text(known[-1])})"


if __name__ == "__main__":
    if sys.argv[1:2] == ["--row"]:
        import torch

        torch.set_num_threads(1)
        task, learner, seed, commit, path = sys.argv[2:]
        write_json(Path(path), asdict(measure(task, learner, int(seed), commit, Path(path).parent / "runs")))
    else:
        parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
        parser.add_argument("folder", type=Path, nargs="?", default=Path("results/learners"))
        parser.add_argument("chosen", nargs="*", metavar="TASK:LEARNER", help="default: all")
        given = parser.parse_args()
        main(given.folder.resolve(), given.chosen)
