"""Nuisance parameters: a sensor's zero, a cable's zero, the distance of an object; and fitted robot options."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from softgym_envs import make_robot
from softgym_envs.config import check_config
from softgym_envs.errors import ConfigError, DataError
from softgym_envs.extensions.design.box import Box
from softgym_envs.extensions.design.calibration import calibrate, make_misfit
from softgym_envs.extensions.design.cli import calibrate as calibrate_command
from softgym_envs.extensions.design.config import CalibrationConfig
from softgym_envs.extensions.design.contact import Plane
from softgym_envs.extensions.design.measurements import measure, write_measurements
from softgym_envs.extensions.design.misfit import LearnedMisfit
from softgym_envs.extensions.design.nuisance import ContactConfig, OffsetConfig
from softgym_envs.extensions.design.parameters import Parameters
from softgym_envs.runs import RunFolder

MODULUS, ZERO = 2.2e6, 0.8
COMMANDS = [[0.002], [0.004], [0.006], [0.008], [0.010]]
OFFSET = {"kind": "offset", "column": "cable_1_effort", "bounds": [-3.0, 3.0], "start": 0.0, "unit": "N"}
CONTACT = {"kind": "contact", "normal": [0.0, 1.0, 0.0], "bounds": [0.015, 0.035], "start": 0.020, "unit": "m"}


@pytest.fixture(scope="module")
def finger():
    return make_robot("finger", cables=1)


@pytest.fixture(scope="module")
def tensions(finger):
    """Cable tensions from a sensor whose zero is 0.8 N off."""
    data = measure(finger, {"young_modulus": MODULUS}, COMMANDS)
    return replace(data, effort=data.effort + ZERO, effector=np.full_like(data.effector, np.nan))


def configured(*fit, **options):
    data = {"name": "x", "robot": "finger", "robot_options": {"cables": 1}, "data": "none", "fit": list(fit)}
    return check_config(CalibrationConfig, {**data, **options}, "test")


def test_without_the_zero_of_the_sensor_the_modulus_is_biased(tensions):
    biased = calibrate(configured("young_modulus"), data=tensions)
    assert biased.design["young_modulus"] > 1.05 * MODULUS
    result = calibrate(configured("young_modulus", nuisances={"zero": OFFSET}), data=tensions)
    assert result.design["young_modulus"] == pytest.approx(MODULUS, rel=0.01)
    assert result.nuisances["zero"] == pytest.approx(ZERO, abs=0.03)
    assert result.fits[0].start["zero"] == 0.0 and "zero" not in result.design
    assert list(result.intervals) == ["young_modulus"]


def test_intervals_allow_for_nuisance_parameters(tensions):
    """An unknown zero makes the modulus less certain, and the interval says so."""
    noisy = tensions.with_noise(0.005, np.random.default_rng(2))
    known = replace(noisy, effort=noisy.effort - ZERO)
    widths = []
    for data, nuisances in ((known, {}), (noisy, {"zero": OFFSET})):
        low, high = calibrate(configured("young_modulus", nuisances=nuisances), data=data).intervals["young_modulus"]
        assert low < MODULUS < high
        widths.append(high - low)
    assert widths[1] > 1.5 * widths[0]


def test_poisson_ratio_distance_of_the_object_and_zero_of_the_sensor(finger):
    """The three unknowns of the thesis, sec. 3.4.5, from the efforts of a finger that pushes against an object."""
    commands = np.linspace(0.001, 0.010, 8)[:, None]
    truth = {"poisson_ratio": 0.46}
    data = measure(finger, truth, commands, plane=Plane(0.022, (0.0, 1.0, 0.0)))
    free = measure(finger, truth, commands)
    touched = data.effector[:, 1] - free.effector[0, 1] < free.effector[:, 1] - free.effector[0, 1] - 1e-4
    assert 2 <= touched.sum() <= 6 and (data.effort[touched] > free.effort[touched]).all()
    data = replace(data, effort=data.effort + 0.3, effector=np.full_like(data.effector, np.nan))
    config = configured(
        "poisson_ratio", nuisances={"zero": OFFSET, "distance": CONTACT}, level=None, backend="fem",
        starts=[{"poisson_ratio": 0.45}], bounds={"poisson_ratio": [0.40, 0.49]},
    )  # fmt: skip
    result = calibrate(config, data=data)
    assert result.design["poisson_ratio"] == pytest.approx(0.46, abs=1e-4)
    assert result.nuisances == pytest.approx({"zero": 0.3, "distance": 0.022}, abs=1e-4)


def test_contact_on_the_surrogate_is_close_to_that_of_fem(finger):
    commands = [[0.006], [0.008], [0.010]]
    free, blocked = (measure(finger, {}, commands, plane=p) for p in (None, Plane(0.038, (0.0, 1.0, 0.0))))
    assert (blocked.effort[-1] > free.effort[-1] + 0.2).all()  # the last state touches
    config = configured("length", nuisances={"distance": {**CONTACT, "bounds": [0.02, 0.05]}})
    misfit = make_misfit(config, blocked, "surrogate")
    point = misfit.parameters.first({"distance": 0.038})
    readings = misfit.readings(point)
    rest = misfit.net(misfit.parameters.design(_tensor(point)), _tensor([0.0]))[1][0, 1].item()
    assert readings[-1, 2] - rest == pytest.approx(0.038, abs=1e-6)
    assert readings[:, 0] == pytest.approx(blocked.effort[:, 0], rel=0.03)


@pytest.mark.parametrize("driven", ["displacement", "effort"])
def test_derivatives_of_residuals_with_nuisance_parameters(finger, driven):
    commands = [[0.004], [0.007], [0.010]] if driven == "displacement" else [[5.0], [10.0], [15.0]]
    data = measure(finger, {}, commands, driven=driven)
    imposed = {"displacement": ("cable_1_displacement", "m", 0.001), "effort": ("cable_1_effort", "N", 0.5)}[driven]
    column, unit, size = imposed
    nuisances = {
        "imposed": OffsetConfig(kind="offset", column=column, bounds=(-size, size), unit=unit),
        "measured": OffsetConfig(kind="offset", column="tip_y", bounds=(-0.001, 0.001), unit="m"),
        "distance": ContactConfig(kind="contact", normal=(0.0, 2.0, 0.0), bounds=(0.02, 0.04), unit="m"),
    }
    box = Box(finger.design_space, ["length", "poisson_ratio"])
    misfit = LearnedMisfit(finger, Parameters(finger, box, nuisances), data)
    point = np.array([0.2, 0.3, 0.1, -0.2, -0.9])
    J = misfit.jacobian(point)
    assert np.linalg.norm(J, axis=0).min() > 1e-3  # every parameter matters
    for k in range(5):
        h = 1e-3 * np.eye(5)[k]
        difference = (misfit.residuals(point + h) - misfit.residuals(point - h)) / 2e-3
        assert np.abs(J[:, k] - difference).max() < 1e-5 * max(np.abs(J).max(), 1.0)


def test_the_zero_of_an_imposed_displacement(finger):
    """A cable that starts 1 mm too short pulls more than its encoder reads."""
    data = measure(finger, {}, np.array(COMMANDS) + 0.001)
    data = replace(data, displacement=data.displacement - 0.001)
    zero = {"kind": "offset", "column": "cable_1_displacement", "bounds": [-0.002, 0.002], "unit": "m"}
    result = calibrate(configured("length", nuisances={"zero": zero}, level=None), data=data)
    assert result.nuisances["zero"] == pytest.approx(-0.001, abs=2e-5)
    assert result.design["length"] == pytest.approx(0.04, abs=5e-5)


def test_a_robot_option_is_fitted_on_fem():
    """The force of the button that a finger presses, from the tension of its cable."""
    robot = make_robot("press_finger", button_force=1.4)
    data = measure(robot, {}, [[0.004, 0.004], [0.008, 0.008]])
    config = check_config(
        CalibrationConfig,
        {
            "name": "x", "robot": "press_finger", "data": "none", "fit": ["robot.button_force"], "level": None,
            "ranges": {"robot.button_force": {"low": 0.5, "high": 4.0, "baseline": 2.0, "unit": "N"}},
            "backend": "fem",
        },
        "test",
    )  # fmt: skip
    assert calibrate(config, data=data).design["robot.button_force"] == pytest.approx(1.4, rel=1e-4)


def test_the_command_reads_data_beside_its_configuration(finger, tensions, tmp_path, monkeypatch):
    folder, elsewhere = tmp_path / "study", tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    write_measurements(folder / "tensions.csv", finger, tensions)
    config = configured("young_modulus", nuisances={"zero": OFFSET}, data="tensions.csv", level=None)
    RunFolder(folder, CalibrationConfig, "a calibration").begin(config)
    done = CliRunner().invoke(calibrate_command, ["--config", str(folder / "config.yaml"), "--folder", "out"])
    assert done.exit_code == 0, done.output
    assert "young_modulus = 2.2" in done.output and "zero = 0." in done.output
    assert json.loads((elsewhere / "out" / "result.json").read_text())["nuisances"]["zero"] == pytest.approx(
        0.8, abs=0.03
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": "kN"}, "unit = 'kN' must be 'N'"),
        ({"column": "cable_1_efort"}, "unknown column 'cable_1_efort'; did you mean 'cable_1_effort'?"),
        ({"start": 30.0}, "start = 30 N is out of bounds; allowed: -3 to 3 N"),
        ({"bounds": [3.0, -3.0]}, r"bounds = \[3.0, -3.0\] must be \[low, high\] with low < high"),
        ({"kind": "drift"}, "'drift'"),
    ],
)
def test_wrong_offsets(changes, message):
    with pytest.raises(ConfigError, match=message):
        configured("young_modulus", nuisances={"zero": {**OFFSET, **changes}})


def test_wrong_nuisance_parameters(tensions):
    with pytest.raises(ConfigError, match="unit = 'mm' must be 'm'"):
        configured("length", nuisances={"distance": {**CONTACT, "unit": "mm"}})
    with pytest.raises(ConfigError, match="three numbers that are not all zero"):
        configured("length", nuisances={"distance": {**CONTACT, "normal": [0, 0, 0]}})
    with pytest.raises(ConfigError, match="'a' and 'b' both describe contact; allowed: one"):
        configured("length", nuisances={"a": CONTACT, "b": CONTACT})
    with pytest.raises(ConfigError, match="'length' is a variable of the body; use another name"):
        configured("young_modulus", nuisances={"length": OFFSET})
    with pytest.raises(ConfigError, match="zero = 5 N is out of bounds"):
        configured("young_modulus", nuisances={"zero": OFFSET}, starts=[{"zero": 5.0}])
    with pytest.raises(ConfigError, match="the column of 'zero' was neither imposed nor measured"):
        calibrate(
            configured("young_modulus", nuisances={"zero": {**OFFSET, "column": "tip_x", "unit": "m"}}), data=tensions
        )
    with pytest.raises(DataError, match="5 measured numbers cannot determine 5 parameters"):
        fit = ["length", "height", "joint_height", "young_modulus"]
        calibrate(configured(*fit, nuisances={"zero": OFFSET}), data=tensions)


def _tensor(values):
    import torch

    return torch.as_tensor(np.asarray(values, dtype=float)[None])
