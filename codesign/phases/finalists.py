"""The check on FEM: the best bodies and the baseline, with their controllers and the inverse QP, on unseen goals.

If the study names a finer mesh, baseline and winner are then tested on it too.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import Evaluation
from softgym_envs.agents.policy import Policy
from softgym_envs.agents.training import train
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import SHARED_POLICY, StudyFolder
from softgym_envs.codesign.phases.ends import check_policy, run_ends
from softgym_envs.codesign.phases.trial import assess, body_training, measure
from softgym_envs.codesign.records import REFINED, Finalist, FinalistTest, FinalistTraining, Job, PlannedTest
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.errors import ConfigError, ConvergenceError, InfeasibleDesign
from softgym_envs.runs import RunFolder
from softgym_envs.storage import read_json

GOALS_PER_JOB = 8
"""Most goals of one job, where tests of ends are slow; the cores share the jobs of one test."""


def finalist_jobs(snapshot: StudySnapshot) -> list[Job]:
    """Return the jobs of all tests, one per body, controller, backend and seed, the slow ones first.

    A slow test of many goals is joined from jobs of its goals. Those on the finer mesh are there once the others are
    done.
    """
    folder, parts, tests = snapshot.folder, [], []
    for plan in [*snapshot.planned_tests, *snapshot.refinements]:
        path = folder.path / plan.file
        goals = range(len(folder.goals[plan.goals])) if plan.numbers is None else plan.numbers
        slow = snapshot.config.finalists.test == "ends" and plan.backend != "surrogate"
        if path.exists() or not slow or len(goals) <= GOALS_PER_JOB:
            tests.append(Job(path, partial(_test, folder, plan)))
            continue
        chunks = np.array_split(np.array(goals), -(-len(goals) // GOALS_PER_JOB))
        files = [path.parent / "parts" / f"{path.stem}-{chunk[0]:03d}.json" for chunk in chunks]
        for file, chunk in zip(files, chunks, strict=True):
            parts.append(Job(file, partial(_test, folder, replace(plan, numbers=tuple(chunk.tolist())))))
        tests.append(Job(path, partial(_join, folder, plan, files), tuple(files)))
    return parts + tests


def fetch_policies(snapshot: StudySnapshot) -> None:
    """Copy the policies of finalists that were trained on other machines into the folder.

    Raises:
        DataError: if a policy is nowhere.
    """
    for finalist in snapshot.finalists:
        if finalist.policy is not None:
            snapshot.folder.policy(finalist.policy)


def policy_file(snapshot: StudySnapshot, finalist: Finalist) -> Path | None:
    """Return the policy of a finalist, copied from another machine if need be; None for the inverse QP.

    It is the first policy that was trained anew for the body, if that lies in this folder, else the one of its trial.

    Raises:
        DataError: if the policy is nowhere.
    """
    if finalist.policy is None:
        return None
    trained = snapshot.folder.path / "finalists" / training_name(finalist.trial, 1) / "policy.safetensors"
    return trained if snapshot.config.finalists.seeds and trained.exists() else snapshot.folder.policy(finalist.policy)


def training_name(trial: int, seed: int) -> str:
    """Return the name of the training of a finalist with a seed."""
    return f"trial{trial:04d}-seed{seed}"


def check_tests(config: StudyConfig) -> None:
    """Build the baseline on FEM as for the tests of the finalists, if these have options of their own (seconds).

    Raises:
        ConfigError: for an option that the backend or the robot does not take, a mesh that is not finer, and a policy
            that a test of ends cannot use.
    """
    found = config.finalists
    if not found.count:
        return
    if found.test == "ends" and config.policy is not None:
        check_policy(config.policy)
    if found.fem_options:
        _try(config, "fem", f"finalists.fem_options = {found.fem_options}")
    if found.refinement is not None:
        options = found.refinement.robot_options
        _try(config, REFINED, f"finalists.refinement.robot_options = {options}")


def _try(config: StudyConfig, backend: str, key: str) -> None:
    environment = finalist_environment(config, backend, {})
    try:
        if backend == "fem":
            environment.make(sample_design=False).close()
        else:
            environment.make_robot()  # meshing it would take long
    except (TypeError, ValueError) as error:
        raise ConfigError(f"finalists cannot be tested with {key}: {error}") from None
    except (InfeasibleDesign, ConvergenceError):  # of the baseline: a result of the test
        pass


def finalist_environment(config: StudyConfig, backend: str, options: Mapping[str, float]) -> EnvironmentConfig:
    """Return the environment in which finalists are tested: on a backend, or on FEM with the finer mesh."""
    refinement = config.finalists.refinement if backend == REFINED else None
    found = config.environment_of(options).on("fem" if backend == REFINED else backend)
    if found.backend == "fem":
        found = found.model_copy(update={"backend_options": {**found.backend_options, **config.finalists.fem_options}})
    if refinement is not None:
        found = found.model_copy(update={"robot_options": {**found.robot_options, **refinement.robot_options}})
    return found


def _test(folder: StudyFolder, plan: PlannedTest) -> FinalistTest:
    config, finalist = folder.config, plan.finalist
    controller: str | Path = plan.agent
    if plan.agent == "policy" and finalist.policy:
        controller = _trained_policy(folder, finalist, plan.seed) if plan.seed else folder.path / finalist.policy
    numbers = None if plan.numbers is None else list(plan.numbers)
    test = FinalistTest(finalist.trial, plan.agent, plan.backend, plan.goals, plan.seed, numbers=numbers)
    environment = finalist_environment(config, plan.backend, finalist.options)
    goals = folder.goals[plan.goals] if numbers is None else folder.goals[plan.goals][numbers]
    try:
        if config.finalists.test == "ends" and plan.backend != "surrogate":
            start = finalist_environment(config, "surrogate", finalist.options)
            steps = config.finalists.last_steps
            total = len(folder.goals[plan.goals])
            names = [f"goal {number + 1} of {total}" for number in (numbers or range(total))]
            ends = run_ends(controller, environment, goals, finalist.design, start=start, last_steps=steps, names=names)
            test.unknowns, test.last_motion = ends.unknowns, ends.last_motion
            found = measure(config, environment, ends.evaluation, finalist.design)
        else:
            found = assess(controller, config, environment, goals, finalist.design)
            if plan.backend != "surrogate":
                test.unknowns = environment.make_robot().build(finalist.design).equations
    except (InfeasibleDesign, ConvergenceError) as error:
        test.error = str(error)
        return test
    test.evaluation, test.values = found.evaluation, found.values
    test.goal_values = found.measurements[config.objective].per_goal
    return test


def _join(folder: StudyFolder, plan: PlannedTest, files: Sequence[Path]) -> FinalistTest:
    """Return a test from those of parts of its goals."""
    config, finalist = folder.config, plan.finalist
    parts = [FinalistTest.read(file) for file in files]
    numbers = None if plan.numbers is None else list(plan.numbers)
    test = FinalistTest(finalist.trial, plan.agent, plan.backend, plan.goals, plan.seed, numbers=numbers)
    test.unknowns = parts[0].unknowns
    test.last_motion = max((part.last_motion for part in parts if part.last_motion is not None), default=None)
    test.error = next((part.error for part in parts if part.error is not None), None)
    if test.error is None:
        evaluation = Evaluation.merge([part.evaluation for part in parts if part.evaluation is not None])
        environment = finalist_environment(config, plan.backend, finalist.options)
        found = measure(config, environment, evaluation, finalist.design)
        test.evaluation, test.values = found.evaluation, found.values
        test.goal_values = found.measurements[config.objective].per_goal
    return test


def _trained_policy(folder: StudyFolder, finalist: Finalist, seed: int) -> Path:
    """Return the policy of a finalist, trained anew with a seed from where the policies of the trials start."""
    config = folder.config
    training = body_training(folder, finalist.design, finalist.options)
    steps = config.finalists.steps or training.steps
    initial = config.policy if config.plan.trains else str(folder.path / SHARED_POLICY)
    update: dict[str, Any] = {"seed": training.seed + seed, "steps": steps}
    if initial is not None:  # its networks decide the architecture
        widths = Policy(initial).widths
        update["settings"] = training.settings.model_copy(update={"net_arch": widths})
    training = training.model_copy(update={**update, "report_every": min(training.report_every, steps)})
    name = training_name(finalist.trial, seed)
    place = folder.path / "finalists" / name
    with folder.lock(f"training-{name}"):
        earlier = RunFolder(place, TrainConfig, "a training")
        if earlier.begun and earlier.config.steps != steps:
            shutil.rmtree(place)  # it has not ended, else the steps could not have changed; all bodies train alike
        policy = train(training, place, initial=initial, progress=False)
        if not (place / "training.json").exists():
            objective = config.primary
            card = read_json(policy.with_suffix(".json"))
            curve = card["curve"]
            FinalistTraining(
                trial=finalist.trial,
                seed=training.seed,
                steps=steps,
                report_steps=len(curve) * training.evaluation_episodes * config.episode_steps,
                cpu_seconds=card["cpu_seconds"],
                # Training does not report every objective.
                curve=[[row["step"], objective.score(row[objective.name])] for row in curve if objective.name in row],
            ).write(place / "training.json")
        return policy
