"""Calibration recovers variables from simulated measurements; malformed files are refused with a reason."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from softgym_envs import make_robot
from softgym_envs.config import check_config
from softgym_envs.errors import ConfigError, DataError
from softgym_envs.extensions.design.box import Box
from softgym_envs.extensions.design.calibration import calibrate, fit_gradient, profile_interval
from softgym_envs.extensions.design.config import CalibrationConfig
from softgym_envs.extensions.design.measurements import Measurements, measure, read_measurements, write_measurements
from softgym_envs.extensions.design.misfit import LearnedMisfit, Misfit
from softgym_envs.extensions.design.parameters import Parameters


@pytest.fixture(scope="module")
def finger():
    return make_robot("finger", cables=1)


@pytest.fixture(scope="module")
def positions(finger):
    """Tip positions at 0, 5 and 10 mm of cable, nu 0.47 (thesis, sec. 4.5.3)."""
    data = measure(finger, {"poisson_ratio": 0.47}, [[0.0], [0.005], [0.010]])
    return replace(data, effort=np.full_like(data.effort, np.nan))


@pytest.fixture(scope="module")
def pulled(finger):
    return measure(finger, {"young_modulus": 2.2e6}, [[2.0], [5.0], [10.0], [15.0]], driven="effort")


def configured(*fit, **options):
    data = {"name": "x", "robot": "finger", "robot_options": {"cables": 1}, "data": "none", "fit": list(fit)}
    return check_config(CalibrationConfig, {**data, **options}, "test")


STARTS = [{"poisson_ratio": nu} for nu in (0.45, 0.47, 0.49)]


def test_poisson_ratio_from_three_starts(finger, positions, tmp_path):
    write_measurements(tmp_path / "measured.csv", finger, positions)
    config = configured("poisson_ratio", starts=STARTS, refine=True, level=None, data=str(tmp_path / "measured.csv"))
    result = calibrate(config, tmp_path / "out")
    found = [fit.found["poisson_ratio"] for fit in result.fits]
    assert np.ptp(found) < 1e-6 and abs(found[0] - 0.47) < 0.003  # on the surrogate
    assert result.design["poisson_ratio"] == pytest.approx(0.47, abs=1e-6)  # and on FEM
    assert json.loads((tmp_path / "out" / "result.json").read_text())["design"] == result.design
    assert (tmp_path / "out" / "calibration.png").read_bytes().startswith(b"\x89PNG")


def test_young_modulus_from_efforts(pulled):
    result = calibrate(configured("young_modulus", level=None), data=pulled)
    assert result.design["young_modulus"] == pytest.approx(2.2e6, rel=0.01)


def test_tpe_agrees_with_the_gradient(positions):
    by_gradient = calibrate(configured("poisson_ratio", level=None), data=positions)
    by_tpe = calibrate(configured("poisson_ratio", method="tpe", trials=80, level=None), data=positions)
    assert by_tpe.design["poisson_ratio"] == pytest.approx(by_gradient.design["poisson_ratio"], abs=5e-4)
    assert by_tpe.fits[0].cost >= by_gradient.fits[0].cost


class Line(Misfit):
    """A body whose tip height is proportional to the command and to the logarithm of its stiffness."""

    def readings(self, point):
        slope = np.log(self.parameters.values(point)["young_modulus"] / 3e6) * self.data.displacement[:, 0]
        return np.stack([0 * slope, 0 * slope, slope, 0 * slope], axis=1)

    def jacobian(self, point):
        return (self.residuals(point + 1e-6) - self.residuals(point - 1e-6))[:, None] / 2e-6


def test_intervals_have_their_nominal_coverage(finger):
    """80 of 100 intervals of 80 % should cover the truth; fewer than 68 or more than 92 has a chance of 0.3 %."""
    rng = np.random.default_rng(4)
    box = Box(finger.design_space, ["young_modulus"])
    command, truth, covered = np.linspace(0.0, 0.01, 8)[:, None], 4e6, 0
    for _ in range(100):
        effector = np.full((8, 3), np.nan)
        effector[:, 1] = np.log(truth / 3e6) * command[:, 0] + rng.normal(0.0, 3e-5, 8)
        data = Measurements("displacement", command, np.full((8, 1), np.nan), effector)
        misfit = Line(finger, Parameters(finger, box), data)
        fit = fit_gradient(misfit, {})
        low, high = profile_interval(misfit, {**box.reference, **fit.found}, "young_modulus", 0.8)
        covered += low <= truth <= high
    assert 68 <= covered <= 92


def test_an_interval_under_noise(pulled):
    noisy = pulled.with_noise(0.01, np.random.default_rng(0))
    result = calibrate(configured("young_modulus"), data=noisy)
    low, high = result.intervals["young_modulus"]
    assert low < 2.2e6 < high and 0.002 < (high - low) / 2.2e6 < 0.1


def test_intervals_of_two_variables(finger):
    """Tensions and positions determine both variables, each less precisely than if the other one were known."""
    data = measure(finger, {"young_modulus": 2.2e6, "poisson_ratio": 0.46}, [[0.004], [0.008], [0.012]])
    data = data.with_noise(0.003, np.random.default_rng(1))
    truth = {"poisson_ratio": 0.46}
    both = calibrate(configured("young_modulus", "poisson_ratio"), data=data).intervals["young_modulus"]
    alone = calibrate(configured("young_modulus", design=truth), data=data).intervals["young_modulus"]
    assert both[0] < 2.2e6 < both[1] and alone[0] < 2.2e6 < alone[1]
    assert both[1] - both[0] > 1.2 * (alone[1] - alone[0])


@pytest.mark.parametrize("driven", ["displacement", "effort"])
def test_derivatives_of_residuals(finger, positions, pulled, driven):
    data = positions if driven == "displacement" else pulled
    box = Box(finger.design_space, ["length", "young_modulus", "poisson_ratio"])
    misfit = LearnedMisfit(finger, Parameters(finger, box), data)
    point = np.array([0.2, 0.1, 0.3])
    J = misfit.jacobian(point)
    for k in range(3):
        h = 1e-3 * np.eye(3)[k]
        difference = (misfit.residuals(point + h) - misfit.residuals(point - h)) / 2e-3
        assert np.abs(J[:, k] - difference).max() < 1e-6 * max(np.abs(J).max(), 1.0)


def test_slack_cables_of_the_surrogate():
    """Surrogate and FEM agree for a command that leaves one cable slack."""
    robot = make_robot("finger")
    data = measure(robot, {}, [[0.012, 0.0], [0.015, 0.001]])
    misfit = LearnedMisfit(robot, Parameters(robot, Box(robot.design_space, ["length"])), data)
    assert misfit.errors(misfit.parameters.point(robot.design_space.baseline))["effector"] < 2e-4


def test_coordinates_are_those_of_equation_3_14(finger):
    """With nu_inf = 0.5: nu = (nu_inf - nu_m)(1 - exp(-nu_0 / tau)) + nu_m."""
    low, high, limit = 0.4, 0.499, 0.5
    coordinates = Parameters(finger, Box(finger.design_space, ["poisson_ratio"], {"poisson_ratio": (low, high)}))
    tau = -1.0 / np.log(1.0 - (high - low) / (limit - low))
    for share in (0.0, 0.3, 1.0):
        nu = (limit - low) * (1.0 - np.exp(-share / tau)) + low
        design = coordinates.values(np.array([2.0 * share - 1.0]))
        assert design["poisson_ratio"] == pytest.approx(nu)
        assert coordinates.point(design)[0] == pytest.approx(2.0 * share - 1.0)
    row = coordinates.design(torch.zeros(1, 1, dtype=torch.float64))[0]
    assert row[:4].tolist() == [finger.design_space.baseline[name] for name in finger.design_space.names[:4]]


def test_a_value_at_its_bound_is_reported(positions):
    result = calibrate(configured("poisson_ratio", bounds={"poisson_ratio": [0.30, 0.46]}, level=None), data=positions)
    assert result.at_bound == ["poisson_ratio"] and result.design["poisson_ratio"] == pytest.approx(0.46)
    assert calibrate(configured("poisson_ratio", level=None), data=positions).at_bound == []


def test_what_cannot_be_fitted(positions):
    with pytest.raises(ConfigError, match="'young_modulus' changes nothing that was measured"):
        calibrate(configured("young_modulus"), data=positions)
    one = replace(positions, **{k: getattr(positions, k)[:1] for k in ("displacement", "effort", "effector")})
    with pytest.raises(DataError, match="there is only one measured state: nothing can be fitted"):
        calibrate(configured("poisson_ratio"), data=one)
    with pytest.raises(ConfigError, match="'length' is not free; free: poisson_ratio"):
        configured("poisson_ratio", starts=[{"length": 0.04}])


HEADER = "cable_1_displacement,tip_y,tip_z\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "it is empty"),
        (HEADER, "it contains no states"),
        (HEADER + "0.0,0.01\n", "row 1 has 2 values, the header 3"),
        (HEADER + "0.0,0.01,abc\n", "column 'tip_z', row 1: 'abc' is not a finite number"),
        (HEADER + "0.0,nan,-0.12\n", "column 'tip_y', row 1: 'nan' is not a finite number"),
        (HEADER + "0.0,0.01,-0.12\n5.0,0.03,-0.11\n", "displacement 5 m of 'cable_1' in row 2 is out of bounds"),
        (HEADER + "0.0,10.5,-120\n", "column 'tip_y' reaches 10.5 m, on a robot of 0.12 m; did you mean metres?"),
        (
            "cable_displacement,tip_y\n0,0\n",
            "unknown column 'cable_displacement'; did you mean 'cable_1_displacement'?",
        ),
        ("tip_y,tip_z\n0,0\n", "it needs the columns cable_1_displacement, or cable_1_effort"),
        ("cable_1_displacement\n0\n", "nothing was measured; give some of"),
        ("cable_1_effort,tip_y\n-1,0\n", "effort -1 of 'cable_1' in row 1 is out of bounds; allowed: 0 to inf"),
        ("tip_y,tip_y\n0,0\n", "has a column twice"),
    ],
)
def test_malformed_csv(finger, tmp_path, text, words):
    path = tmp_path / "measured.csv"
    path.write_text(text)
    with pytest.raises(DataError) as error:
        read_measurements(path, finger)
    assert words in str(error.value) and str(path) in str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "cannot be read"),
        ("3", "a list of records, or an object of columns"),
        ('[{"tip_y": 1}, {"tip_z": 1}]', "record 2 has tip_z, the first tip_y"),
        ('{"tip_y": [1], "tip_z": [1, 2]}', "differ in length"),
        ('{"cable_1_displacement": [null], "tip_y": [0]}', "None is not a finite number"),
    ],
)
def test_malformed_json(finger, tmp_path, text, words):
    path = tmp_path / "measured.json"
    path.write_text(text)
    with pytest.raises(DataError) as error:
        read_measurements(path, finger)
    assert words in str(error.value)


def test_files_are_read_as_they_were_written(finger, tmp_path, positions, pulled):
    for data in (positions, pulled):
        write_measurements(tmp_path / "measured.csv", finger, data)
        back = read_measurements(tmp_path / "measured.csv", finger)
        assert back.driven == data.driven and (back.command == data.command).all()
        assert (back.effector == data.effector).all()
    records = [{"cable_1_displacement": 0.0, "tip_z": -0.12}, {"cable_1_displacement": 0.01, "tip_z": -0.1}]
    (tmp_path / "measured.json").write_text(json.dumps(records))
    back = read_measurements(tmp_path / "measured.json", finger)
    assert back.effector[:, 2].tolist() == [-0.12, -0.1] and np.isnan(back.effector[:, :2]).all()
    with pytest.raises(DataError, match="No such file"):
        read_measurements(tmp_path / "nothing.csv", finger)
    with pytest.raises(DataError, match="must end with .csv or .json"):
        read_measurements(tmp_path / "measured.txt", finger)
