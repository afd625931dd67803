"""Learners compared: CPU seconds to 90 and 95 % of unseen goals on the surrogate, and success of the policies on FEM.

    python -m benchmarks.learners results/learners finger_reach:analytic finger_reach:sac

trains the configuration of each named task and learner (default: all of them, cheapest first) with three seeds. Each
training is a row of its own in a file of its own, and rows that exist are not computed again. The rows that this
repository keeps are in ``benchmarks/data/learners.json``; ``softgym bench learners`` shows them.
"""

from __future__ import annotations

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
TASKS = ("finger_reach", "diamond_reach", "trunk_reach", "cable_trunk_reach")
REPORTS = {"analytic": 6_400, "cloning": 3_200, "ppo": 12_800, "sac": 1_600}
"""Learners, and environment steps between evaluations; these do not count as learning."""
SEEDS = (0, 1, 2)
GOALS, FEM_GOALS = 200, 50
"""Unseen goals of each evaluation during training, and others for the policy that is kept, on FEM."""


@dataclass(frozen=True)
class LearnerRow:
    """One training.

    Attributes:
        task: name of the configuration of SAC.
        learner: name of the learner.
        seed: seed of the training.
        seconds_90: CPU seconds of learning until 90 % of the goals are reached; None if they never are.
        seconds_95: the same for 95 %.
        seconds: CPU seconds of learning of the whole training.
        steps: environment steps of the whole training.
        success: share of the goals that the kept policy reaches on the surrogate.
        fem_success: share of the other goals that it reaches on FEM.
        commit: of the code.
    """

    task: str
    learner: str
    seed: int
    seconds_90: float | None
    seconds_95: float | None
    seconds: float
    steps: int
    success: float
    fem_success: float
    commit: str


def measure(task: str, learner: str, seed: int, folder: Path) -> LearnerRow:
    """Train and evaluate one policy."""
    from softgym_envs.agents.config import TrainConfig
    from softgym_envs.agents.evaluation import evaluate
    from softgym_envs.agents.policy import Policy
    from softgym_envs.agents.sweep import unseen_goals
    from softgym_envs.agents.training import train

    name = task if learner == "sac" else f"{task}_{learner}"
    update = {"seed": seed, "evaluation_episodes": GOALS, "report_every": REPORTS[learner]}
    config = load_config(CONFIGS / f"{name}.yaml", TrainConfig).model_copy(update=update)
    policy = train(config, folder / f"{name}_{seed}", progress=False)
    curve = Policy(policy).card["curve"]
    _, goals = unseen_goals(config.environment, FEM_GOALS)
    fem = evaluate(policy, config.environment.on("fem"), goals)
    best = max(curve, key=lambda point: point["mean_return"])
    seconds = [
        next((point["learning_seconds"] for point in curve if point["success_rate"] >= share), None)
        for share in (0.9, 0.95)
    ]
    whole, steps = curve[-1]["learning_seconds"], curve[-1]["step"]
    commit = provenance()["commit"]
    return LearnerRow(task, learner, seed, *seconds, whole, steps, best["success_rate"], fem.success_rate, commit)


def main(folder: Path, chosen: list[str]) -> None:
    """Compute the rows that are missing, each in a process of its own, and write them to the kept file."""
    pairs = [name.split(":") for name in chosen] or [[task, learner] for learner in REPORTS for task in TASKS]
    for seed in SEEDS:
        for task, learner in pairs:
            path = folder / f"{task}_{learner}_{seed}.json"
            if not path.exists():
                subprocess.run(
                    [sys.executable, "-m", "benchmarks.learners", "--row", task, learner, str(seed), str(path)],
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
    """CPU seconds to 90 and 95 % of unseen goals, and success on FEM: for each task and learner, a list over seeds."""
    kept = rows()
    result: dict[str, object] = {}
    for task in TASKS:
        for learner in REPORTS:
            found = [row for row in kept if (row.task, row.learner) == (task, learner)]
            if not found:
                result[f"{task}, {learner}"] = "not run"
                continue
            result |= {
                f"{task}, {learner}: CPU seconds to 90 %": [row.seconds_90 for row in found],
                f"{task}, {learner}: CPU seconds to 95 %": [row.seconds_95 for row in found],
                f"{task}, {learner}: CPU seconds of the training": [row.seconds for row in found],
                f"{task}, {learner}: goals reached on the surrogate [%]": [100 * row.success for row in found],
                f"{task}, {learner}: goals reached on FEM [%]": [100 * row.fem_success for row in found],
            }
    return result


def spread(values: list[float | None], form: str = ".3g") -> str:
    """Write the values of the seeds: median (smallest to largest); None stands for "never"."""
    known = sorted(np.inf if value is None else value for value in values)

    def text(value: float) -> str:
        return "never" if np.isinf(value) else f"{value:{form}}"

    middle = text(known[(len(known) - 1) // 2] if np.isinf(known).any() else float(np.median(known)))
    return middle if known[0] == known[-1] else f"{middle} ({text(known[0])} to {text(known[-1])})"


if __name__ == "__main__":
    if sys.argv[1:2] == ["--row"]:
        import torch

        torch.set_num_threads(1)
        task, learner, seed, path = sys.argv[2:]
        write_json(Path(path), asdict(measure(task, learner, int(seed), Path(path).parent / "runs")))
    else:
        main(Path(sys.argv[1] if sys.argv[1:] else "results/learners").resolve(), sys.argv[2:])
