"""Statistics, sweeps, tables and exported policies."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.cli.app import main
from softgym_envs.config import check_config, difference, load_config, shipped_configs
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.errors import ConfigError, DataError
from softgym_envs.extensions.sweeps import sweep
from softgym_envs.extensions.sweeps.results import draw_curves, load_runs, table
from softgym_envs.extensions.sweeps.statistics import crossed_estimate, interquartile_mean, stratified_estimate
from softgym_envs.extensions.sweeps.sweep import run_sweep
from softgym_envs.runs import RunFolder

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = list(shipped_configs("agents").values())

TINY = """
environment: {id: SoftGym/FingerReach-v0}
sac: {net_arch: [8, 8], batch_size: 16, learning_starts: 32, gradient_steps: 1, hindsight: 0.8}
steps: 400
num_envs: 8
evaluation_episodes: 4
report_every: 200
"""


def test_every_environment_has_a_configuration():
    found = {load_config(path, TrainConfig).environment.id for path in CONFIGS}
    assert found == set(ENVIRONMENTS)
    names = {path.stem for path in CONFIGS}
    assert {
        f"{name}_designs" for name in ("diamond_reach", "trunk_reach", "cable_trunk_reach", "gripper_pinch")
    } <= names


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_configurations_fit_their_environment(path):
    config = load_config(path, TrainConfig)
    row = ENVIRONMENTS[config.environment.id]
    # A part of the training that ended within an episode would cut it off.
    assert config.report_every % (config.num_envs * row.max_episode_steps) == 0 or row.backend == "fem"
    assert config.steps % config.report_every == 0
    assert config.environment.sample_design == config.environment.design_in_observation
    if config.learner == "sac" and config.settings.hindsight:
        assert config.environment.task_class.horizon == 1  # hindsight needs a goal that stays


def test_interquartile_mean():
    assert interquartile_mean(np.arange(8.0)) == 3.5
    assert interquartile_mean(np.array([[0.0, 1.0, 2.0, 1000.0]])) == 1.5
    assert interquartile_mean(np.array([3.0])) == 3.0


def test_intervals_have_about_their_nominal_coverage():
    rng = np.random.default_rng(0)
    stratified = crossed = 0
    for _ in range(60):
        tasks = rng.normal(size=(10, 6))
        estimate = stratified_estimate(tasks, resamples=300)
        stratified += estimate.low <= 0.0 <= estimate.high
        seeds = rng.normal(size=(10, 1)) + rng.normal(size=(1, 30)) + rng.normal(size=(10, 30))
        estimate = crossed_estimate(seeds, resamples=300)
        assert estimate.value == pytest.approx(interquartile_mean(seeds))
        crossed += estimate.low <= 0.0 <= estimate.high
    assert 51 <= stratified and 51 <= crossed  # 57 expected of 60


def test_crossed_intervals_account_for_the_policy_that_a_seed_shares():
    rng = np.random.default_rng(1)
    seeds = rng.normal(size=(4, 1)) + 0.01 * rng.normal(size=(4, 200))
    one = crossed_estimate(seeds)
    assert one.high - one.low > 0.5  # four policies, not 800 samples
    entries = stratified_estimate(seeds)
    assert entries.high - entries.low < 0.3


def test_scores_that_cannot_be_resampled_have_no_interval():
    assert np.isnan(crossed_estimate(np.ones((1, 1))).low)
    assert np.isnan(stratified_estimate(np.ones((1, 5))).low)
    assert crossed_estimate(np.array([[1.0, 2.0, 3.0, 4.0]])).low < 2.0
    assert crossed_estimate(np.array([[1.0], [2.0]])) != crossed_estimate(np.array([[1.0], [1.0]]))
    with pytest.raises(ValueError, match="finite table"):
        crossed_estimate(np.array([[1.0, np.nan]]))
    with pytest.raises(ValueError, match="finite table"):
        stratified_estimate(np.ones(3))


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "tiny.yaml").write_text(TINY)
    command = [sys.executable, "-m", "softgym_envs.cli", "sweep", "tiny.yaml", "--seed", "0", "--seed", "3"]
    command += ["--workers", "2", "--folder", "out", "--goals", "5", "--fem-goals", "2"]
    done = subprocess.run(command, cwd=folder, env=_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def _environment():
    import os

    return {**os.environ, "PYTHONPATH": str(ROOT)}


def test_a_sweep_writes_results_of_every_seed_and_the_baselines(swept):
    place = swept / "out" / "results" / "tiny"
    assert {path.name for path in place.iterdir()} == {"seed0.json", "seed3.json", "baselines.json"}
    run = json.loads((place / "seed3.json").read_text())
    assert run["config"]["seed"] == 3 and [row["step"] for row in run["curve"]] == [200, 400]
    assert {backend: len(found["sac"]["distances"]) for backend, found in run["evaluations"].items()} == {
        "surrogate": 5,
        "fem": 2,
    }
    baselines = json.loads((place / "baselines.json").read_text())["evaluations"]
    assert set(baselines["fem"]) == {"qp", "qp_model", "qp_pi", "random"}
    assert max(baselines["surrogate"]["qp"]["distances"]) < 1e-4 < min(baselines["surrogate"]["random"]["distances"])


def test_a_finished_sweep_runs_nothing_and_a_lost_result_is_computed_again(swept, monkeypatch):
    place = swept / "out" / "results" / "tiny"
    before = (place / "seed0.json").read_text()
    monkeypatch.setattr("softgym_envs.agents.training.LEARNERS", {})  # a training would fail
    assert run_sweep([swept / "tiny.yaml"], [0, 3], 1, swept / "out", goals=5, fem_goals=2) == 0
    (place / "seed0.json").unlink()
    assert run_sweep([swept / "tiny.yaml"], [0, 3], 1, swept / "out", goals=5, fem_goals=2) == 0
    again, first = json.loads((place / "seed0.json").read_text()), json.loads(before)
    assert (
        again["evaluations"]["surrogate"]["sac"]["distances"] == first["evaluations"]["surrogate"]["sac"]["distances"]
    )


def test_a_sweep_refuses_results_of_another(swept, tmp_path):
    out = swept / "out"
    given = {"goals": 5, "fem_goals": 2}
    other = tmp_path / "tiny.yaml"
    other.write_text(TINY.replace("gradient_steps: 1", "gradient_steps: 2"))
    with pytest.raises(ConfigError, match=r"holds a sweep with configs\.tiny\.sac\.gradient_steps = 1, got 2; use"):
        run_sweep([other], [0], 1, out, **given)
    with pytest.raises(ConfigError, match=r"holds a sweep with goals = 5, got 6; use another folder"):
        run_sweep([swept / "tiny.yaml"], [0], 1, out, goals=6, fem_goals=2)
    with RunFolder(out, sweep.SweepConfig, "a sweep").alone():
        with pytest.raises(ConfigError, match="in use by another process"):
            run_sweep([swept / "tiny.yaml"], [0], 1, out, **given)
    place = out / "results" / "tiny"
    for text in ("{", "[]", (place / "seed0.json").read_text()):  # the last one is of another seed
        (place / "seed1.json").write_text(text)
        with pytest.raises(DataError, match=r"seed1\.json' (cannot be read|was edited, damaged or renamed).*remove it"):
            run_sweep([swept / "tiny.yaml"], [1], 1, out, **given)
    (place / "seed1.json").unlink()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_stored_results_are_of_the_shipped_configurations(path):
    config = load_config(path, TrainConfig)
    for stored in sorted((ROOT / "agents" / "results" / path.stem).glob("seed*.json")):
        run = json.loads(stored.read_text())
        old = check_config(TrainConfig, run["config"], f"result '{stored}'")
        assert difference(old, config.model_copy(update={"seed": run["seed"]})) is None


def test_an_error_in_one_job_does_not_stop_the_others(swept, tmp_path, capsys):
    (tmp_path / "tiny.yaml").write_text(TINY)
    broken = tmp_path / "out" / "runs" / "tiny" / "seed1"
    broken.mkdir(parents=True)
    (broken / "config.yaml").write_text((swept / "out/runs/tiny/seed0/config.yaml").read_text())  # of seed 0
    assert run_sweep([tmp_path / "tiny.yaml"], [1], 1, tmp_path / "out", goals=2, fem_goals=0) == 1
    assert "holds a training with seed = 0, got 1" in capsys.readouterr().out
    assert (tmp_path / "out/results/tiny/baselines.json").exists()
    (tmp_path / "bad.yaml").write_text("environment: {id: SoftGym/Octopus-v0}")
    with pytest.raises(ConfigError, match="Octopus"):
        run_sweep([tmp_path / "bad.yaml"], [1], 1, tmp_path / "out")


def test_environments_on_fem_are_evaluated_on_the_goals_for_fem(tmp_path):
    on_fem = EnvironmentConfig(id="SoftGym/FingerReach-v0", backend="fem")
    found = sweep._evaluations(on_fem, {"random": "random"}, 5, 2)
    assert {backend: len(agents["random"]["distances"]) for backend, agents in found.items()} == {"fem": 2}
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY.replace("v0}", "v0, backend: fem}"))
    with pytest.raises(ConfigError, match=r"fem_goals = 0, but the environment of '.*tiny\.yaml' runs on FEM"):
        run_sweep([path], [0], 1, tmp_path / "out", goals=5, fem_goals=0)
    assert not (tmp_path / "out").exists()


def test_final_goals_are_unseen_and_equal_goals_are_evaluated_once():
    from softgym_envs.agents.evaluation import evaluation_set
    from softgym_envs.agents.training import EVALUATION_SEED

    reach = EnvironmentConfig(id="SoftGym/FingerReach-v0")
    _, goals = sweep.unseen_goals(reach, 6)
    _, chosen = evaluation_set(reach, 6, EVALUATION_SEED)
    assert goals.shape == (6, 1, 3) and not np.isin(goals, chosen).any()
    assert sweep.unseen_goals(EnvironmentConfig(id="SoftGym/DiamondTrack-v0"), 6)[1].shape[0] == 1
    designs, goals = sweep.unseen_goals(reach.model_copy(update={"sample_design": ["length"]}), 3)
    assert len({design["length"] for design in designs}) == len(goals) == 3


def test_the_table_and_the_curves(swept, tmp_path):
    runs = load_runs(swept / "out" / "results")
    text = table(runs)
    assert text.count("| tiny |") == 4
    qp = next(line for line in text.splitlines() if line.startswith("| tiny |")).split("|")[3]
    scores = 1e3 * runs[0].scores("qp", "own", "distances")
    assert float(qp.split("[")[0]) == pytest.approx(interquartile_mean(scores), rel=0.5)
    assert "seeds (2)" in text and "SAC, PPO and evolution are model-free" in text
    assert "| SAC | QP |" in text  # learners without results have no column
    picture = draw_curves(runs, tmp_path / "curves.png")
    assert picture.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(DataError, match="contains no results"):
        load_runs(tmp_path)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "seed0.json").write_text("{")
    with pytest.raises(DataError, match=r"seed0\.json' cannot be read"):
        load_runs(tmp_path)


def test_an_interrupted_sweep_says_how_to_go_on(swept, monkeypatch, tmp_path):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "run_sweep", interrupt)
    command = ["sweep", str(swept / "tiny.yaml"), "--folder", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["softgym", *command])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 130
