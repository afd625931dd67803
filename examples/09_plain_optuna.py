"""Body and policy in a sweep of your own: Optuna outside, a policy trained for each body inside, poor bodies pruned."""

import tempfile

import numpy as np
import optuna

from softgym_envs import make_robot
from softgym_envs.agents import EnvironmentConfig, TrainConfig, evaluate, train

zone = np.array([0.0, 0.066, -0.072]) + np.random.default_rng(0).uniform(-1, 1, (12, 3)) * [0.010, 0.003, 0.003]  # m


def objective(trial):
    design = {v.name: trial.suggest_float(v.name, v.low, v.high) for v in space if v.unit == "m"}
    environment = EnvironmentConfig(id="SoftGym/FingerReach-v0", design=design, task_options={"goals": zone.tolist()})
    config = TrainConfig(environment=environment, learner="analytic", steps=25600, report_every=12800, seed=0)

    def report(step, evaluation):
        trial.report(1e3 * evaluation.mean_distance, step)
        return trial.should_prune()

    with tempfile.TemporaryDirectory() as folder:
        policy = train(config, f"{folder}/policy", report=report, progress=False)
        distance = 1e3 * evaluate(policy, environment, zone).mean_distance  # mm
    if trial.should_prune():
        raise optuna.TrialPruned
    return distance


space = make_robot("finger").design_space
optuna.logging.set_verbosity(optuna.logging.WARNING)
pruner = optuna.pruners.MedianPruner(n_startup_trials=3)
study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0), pruner=pruner)
study.optimize(objective, n_trials=8)
pruned = sum(trial.state == optuna.trial.TrialState.PRUNED for trial in study.trials)
print(f"8 bodies, {pruned} pruned; best: {study.best_value:.2f} mm with {study.best_params}")
