"""Search and sensitivity: fronts, interruptions, infeasible designs; indices of known functions."""

import json
from pathlib import Path

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.codesign.scoring import Evaluator
from softgym_envs.config import check_config, load_config
from softgym_envs.errors import ConfigError, ConvergenceError, InfeasibleDesign
from softgym_envs.extensions.design import calibration, gradient
from softgym_envs.extensions.design import gradient_free as module
from softgym_envs.extensions.design.box import Box
from softgym_envs.extensions.design.config import CalibrationConfig, OptimiseConfig, SensitivityConfig
from softgym_envs.extensions.design.gradient_free import search
from softgym_envs.extensions.design.sensitivity import analyse_sensitivity, morris, one_at_a_time, sample, sobol
from softgym_envs.storage import read_signed, write_signed

CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "design"
BODIES = {
    "robot": "finger",
    "robot_options": {"cables": 1},
    "variables": ["length", "height", "joint_height"],
    "actuation": [0.01],
}
SAMPLER = {"name": "nsgaii", "seed": 3, "options": {"population_size": 6}}


def configured(**changes):
    data = {
        "name": "x",
        "bodies": BODIES,
        "objectives": [{"metric": "bending_angle"}, {"metric": "contact_force"}],
        "solver": {"method": "search", "sampler": SAMPLER, "trials": 20, "batch": 6},
    }
    return check_config(OptimiseConfig, {**data, **changes}, "test")


class Stub(Evaluator):
    """An evaluator with infeasible designs that stops after a number of evaluations."""

    stop = np.inf
    count = 0

    def __init__(self):
        super().__init__(())

    def measure(self, design):
        Stub.count += 1
        if Stub.count > Stub.stop:
            raise KeyboardInterrupt
        if design["joint_height"] > 0.0072:
            raise InfeasibleDesign("too thick")
        return {"bending_angle": design["length"] + design["height"], "contact_force": -design["length"]}


@pytest.fixture
def stub(monkeypatch):
    monkeypatch.setattr("softgym_envs.extensions.design.config.BodiesConfig.evaluator", lambda *arguments: Stub())
    monkeypatch.setattr(Stub, "count", 0)
    monkeypatch.setattr(Stub, "stop", np.inf)
    return Stub


def test_an_interrupted_search_has_the_same_result(stub, monkeypatch, tmp_path):
    whole = search(configured(), tmp_path / "whole", progress=False)
    assert whole.infeasible > 0 and whole.feasible + whole.infeasible == 20
    stub.count = 0
    for stop in (4, 11):
        stub.stop = stop
        with pytest.raises(KeyboardInterrupt):
            search(configured(), tmp_path / "parts", progress=False)
        stub.count = stop
    with (tmp_path / "parts" / "journal.log").open("a") as stream:
        stream.write('{"op_code": 5, "wor')  # as after a crash
    stub.stop = np.inf
    parts = search(configured(), tmp_path / "parts", progress=False)
    assert parts.front == whole.front
    rows = [line.split(",") for line in (tmp_path / "whole" / "trials.csv").read_text().splitlines()[1:]]
    found = {(float(row[4]), float(row[5])) for row in rows if row[4]}
    best = {(x, y) for x, y in found if not any(a >= x and b >= y and (a, b) != (x, y) for a, b in found)}
    assert {(row.metrics["bending_angle"], row.metrics["contact_force"]) for row in whole.front} == best
    assert (tmp_path / "parts" / "trials.csv").read_text().count("\n") == 21
    assert (tmp_path / "parts" / "front.png").read_bytes().startswith(b"\x89PNG")
    more = configured(solver={"method": "search", "sampler": SAMPLER, "trials": 26, "batch": 6})
    before = stub.count
    longer = search(more, tmp_path / "parts", progress=False)
    assert longer.feasible + longer.infeasible == 26 and stub.count - before <= 6
    with pytest.raises(ConfigError, match="holds a search with objectives = .*, or change only: name, workers"):
        search(configured(objectives=[{"metric": "travel"}]), tmp_path / "parts", progress=False)


def test_starts_lie_within_the_bounds(stub, tmp_path):
    def asked(**start):
        bodies = {**BODIES, "bounds": {"length": [0.041, 0.042]}}
        solver = {"method": "search", "sampler": {"name": "random"}, "trials": 3, "starts": [start]}
        return configured(bodies=bodies, solver=solver)

    with pytest.raises(ConfigError, match="starts: 'heigth' is not free; free: length, "):
        asked(heigth=0.021)
    with pytest.raises(ConfigError, match="length"):
        asked(length=0.040)
    search(asked(height=0.0205), tmp_path, progress=False)
    rows = [row.split(",") for row in (tmp_path / "trials.csv").read_text().splitlines()]
    first = dict(zip(*rows[:2], strict=True))
    assert (float(first["length"]), float(first["height"])) == (0.041, 0.0205)


@pytest.mark.parametrize("sampler", [SAMPLER, {"name": "tpe", "seed": 3}])
@pytest.mark.parametrize("parameters", [1, 15, 26, 27])  # the first batch has 18 parameters
def test_a_search_that_was_interrupted_while_it_proposed(sampler, parameters, stub, monkeypatch, tmp_path):
    import optuna

    starts = [{"length": 0.039}, {"length": 0.0415}]
    solver = {"method": "search", "sampler": sampler, "trials": 14, "batch": 6, "starts": starts}
    config = configured(objectives=[{"metric": "bending_angle"}], solver=solver)

    def designs(folder):
        rows = (folder / "trials.csv").read_text().splitlines()[1:]
        return [row.split(",")[1:-1] for row in rows]  # without number and seconds

    whole = search(config, tmp_path / "whole", progress=False)
    suggest, count = optuna.Trial._suggest, 0

    def stop(self, *arguments):
        nonlocal count
        count += 1
        if count == parameters:
            raise KeyboardInterrupt
        return suggest(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(optuna.Trial, "_suggest", stop)
        with pytest.raises(KeyboardInterrupt):
            search(config, tmp_path / "parts", progress=False)
    parts = search(config, tmp_path / "parts", progress=False)
    assert designs(tmp_path / "parts") == designs(tmp_path / "whole") and len(designs(tmp_path / "parts")) == 14
    for name in ("feasible", "infeasible", "repeated"):
        assert getattr(parts, name) == getattr(whole, name)
    assert parts.front[0].design == whole.front[0].design
    assert stub.count == 2 * (14 - whole.repeated)  # nothing was evaluated again


def test_folders_of_other_runs_are_not_changed(stub, tmp_path):
    def contents():
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    search(configured(), tmp_path, progress=False)
    before = contents()
    descent = check_config(OptimiseConfig, {**configured().model_dump(), "solver": {"method": "gradient"}}, "test")
    with pytest.raises(ConfigError, match=f"'{tmp_path}' holds an optimisation with solver"):
        gradient.optimise(descent, tmp_path)
    fit = load_config(CONFIGS / "finger_calibration.yaml", CalibrationConfig)
    with pytest.raises(ConfigError, match=f"'{tmp_path}' does not hold a calibration: config"):
        calibration.calibrate(fit, tmp_path)
    assert contents() == before
    (tmp_path / "config.yaml").unlink()
    with pytest.raises(ConfigError, match="holds journal.log but no config.yaml"):
        search(configured(), tmp_path, progress=False)


def test_two_searches_in_one_folder(stub, monkeypatch, tmp_path):
    def other(self, design):
        with pytest.raises(ConfigError, match=f"folder '{tmp_path}' is in use by another process; wait, or use"):
            search(configured(), tmp_path, progress=False)
        return {"bending_angle": design["length"], "contact_force": -design["length"]}

    monkeypatch.setattr(stub, "measure", other)
    assert search(configured(), tmp_path, progress=False).feasible == 20
    assert search(configured(), tmp_path, progress=False).feasible == 20


def test_generations_of_nsga_are_full(stub, tmp_path):
    import optuna

    search(configured(), tmp_path, progress=False)
    study = module._Ledger(configured(), tmp_path)._study
    generations = [
        trial.system_attrs["NSGAIISampler:generation"]
        for trial in study.get_trials(states=(optuna.trial.TrialState.COMPLETE,))
    ]
    assert all(generations.count(k) == 6 for k in range(max(generations)))


def test_nothing_feasible(stub, tmp_path):
    bodies = {**BODIES, "bounds": {"joint_height": (0.0075, 0.008)}}
    with pytest.raises(ConvergenceError, match="none of 20 designs is feasible; the first: too thick"):
        search(configured(bodies=bodies), tmp_path, progress=False)


def test_search_on_the_surrogate_by_tpe(tmp_path):
    solver = {"method": "search", "trials": 40, "starts": [{"length": 0.042}]}
    config = configured(objectives=[{"metric": "bending_angle"}], solver=solver)
    (best,) = search(config, tmp_path, progress=False).front
    assert best.metrics["bending_angle"] > 0.525
    first = (tmp_path / "trials.csv").read_text().splitlines()[1].split(",")
    assert float(first[1]) == 0.042


def ishigami(unit):
    """Return Ishigami's function of points in [-1, 1]^3, scaled to pi; its indices are known."""
    x = np.pi * unit
    return np.sin(x[:, 0]) + 7.0 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])


def study(method, **changes):
    return check_config(
        SensitivityConfig,
        {"name": "x", "bodies": BODIES, "metrics": ["bending_angle"], "method": method, **changes},
        "t",
    )


def test_sobol_indices_of_a_known_function():
    config = study("sobol", samples=2048)
    box = config.bodies.box()
    values = ishigami(sample(config, box))
    table = sobol(values, box, 0.95, 0)
    for (first, total), row in zip(((0.3139, 0.5576), (0.4424, 0.4424), (0.0, 0.2437)), table.values(), strict=True):
        assert row["first"] == pytest.approx(first, abs=0.03) and row["total"] == pytest.approx(total, abs=0.03)
    values[::40] = np.nan
    assert sobol(values, box, 0.95, 0)["height"]["first"] == pytest.approx(0.4424, abs=0.08)
    with pytest.raises(ConvergenceError, match="narrow the bounds"):
        sobol(np.full_like(values, np.nan), box, 0.95, 0)


def test_morris_effects_of_a_known_function():
    config = study("morris", levels=4, samples=20)
    box = config.bodies.box()
    points = sample(config, box)
    values = 3.0 * points[:, 0] - points[:, 1] ** 3
    table = morris(points, values, box, 4, 0.95, 0)
    assert table["length"]["mu"] == pytest.approx(6.0) and table["length"]["sigma"] == pytest.approx(0.0, abs=1e-9)
    assert table["height"]["mu"] < 0.0 and table["joint_height"]["mu_star"] == pytest.approx(0.0)


def test_one_at_a_time_is_equation_3_1():
    box = Box(make_robot("finger", cables=1).design_space, BODIES["variables"], None, {"height": 0.021})
    points = sample(study("oat", bodies={**BODIES, "design": {"height": 0.021}}), box)
    assert len(points) == 7 and (points[0] == box.unit(box.reference)).all()
    values = 4.0 * points[:, 0] + points[:, 1]  # 4 * [-1, 1] and [-1, 1] about the reference, which is (0, 0)
    table = one_at_a_time(points, values, box)
    assert [table[name]["share"] for name in BODIES["variables"]] == pytest.approx([100.0, 25.0, 0.0])
    values[1] = np.nan
    table = one_at_a_time(points, values, box)
    assert table["length"]["infeasible"] == 1 and table["length"]["low"] == pytest.approx(0.0)


def test_an_interrupted_sensitivity_study_continues(tmp_path):
    config = study("oat", metrics=["bending_angle", "normal_force"])
    result = analyse_sensitivity(config, tmp_path, progress=False)
    records = (tmp_path / "evaluations.jsonl").read_bytes().splitlines(keepends=True)
    (tmp_path / "evaluations.jsonl").write_bytes(b"".join(records[:3]) + records[3][:20])
    assert analyse_sensitivity(config, tmp_path, progress=False).indices == result.indices
    assert (tmp_path / "evaluations.jsonl").read_bytes().count(b"\n") == 7
    assert read_signed(tmp_path / "result.json")["indices"] == result.indices
    assert (tmp_path / "sensitivity.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match="holds a sensitivity study with metrics"):
        analyse_sensitivity(study("oat"), tmp_path, progress=False)


def begun_by_other_code(folder):
    """Let the provenance of a folder say that other code began its results; return this provenance."""
    record = read_signed(folder / "provenance.json") | {"sources": "other", "commit": None}
    write_signed(folder / "provenance.json", record)
    return record


def test_a_continued_run_keeps_its_first_provenance(stub, tmp_path, capsys):
    def run_search(trials):
        solver = {"method": "search", "sampler": SAMPLER, "trials": trials, "batch": 6}
        search(configured(solver=solver), tmp_path / "search")

    def run_sensitivity(workers):
        analyse_sensitivity(study("oat", workers=workers), tmp_path / "sensitivity")

    for run, name, kind in (
        (run_search, "search", "search"),
        (run_sensitivity, "sensitivity", "sensitivity study"),
    ):
        folder = tmp_path / name
        run(1)
        begun = read_signed(folder / "provenance.json")
        run(1)  # by the same code
        assert read_signed(folder / "provenance.json") == begun
        assert json.loads((folder / "result.json").read_text())["code_changes"] == []
        begun = begun_by_other_code(folder)
        capsys.readouterr()
        run(2)
        kept = read_signed(folder / "provenance.json")
        (continued,) = kept.pop("continued")
        change = f"begun with sources other; continued with sources {continued['sources']}"
        assert kept == begun
        assert f"warning: {kind} '{folder}' was {change}; what they compute may differ" in capsys.readouterr().err
        assert json.loads((folder / "result.json").read_text())["code_changes"] == [change]


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_configurations_load(path):
    text = path.read_text()
    verb = text[text.index("softgym ") :].split()[1]
    load_config(
        path, {"sensitivity": SensitivityConfig, "optimise": OptimiseConfig, "calibrate": CalibrationConfig}[verb]
    )


def test_wrong_configurations():
    with pytest.raises(ConfigError, match="must equal the population of NSGA-II, population_size = 6"):
        configured(solver={"method": "search", "sampler": SAMPLER, "trials": 20, "batch": 5})
    with pytest.raises(ConfigError, match="power of two"):
        study("sobol", samples=100)
    with pytest.raises(ConfigError, match="must be even"):
        study("morris", levels=5)
