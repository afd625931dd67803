"""Calibration of drives and the sensor's frame: derivatives, known truth, held-out trials, what is not determined."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.config import check_config
from softgym_envs.envs.plant import play
from softgym_envs.errors import DataError
from softgym_envs.extensions.design.calibration import calibrate, make_misfit
from softgym_envs.extensions.design.config import CalibrationConfig
from softgym_envs.extensions.design.measurements import Measurements, read_measurements, write_measurements
from softgym_envs.extensions.design.nuisance import make_instrument

COLUMNS = [f"cable_{k}_displacement" for k in (1, 2)]
TRUTH = {"gain": 0.93, "zero": 6e-4, "play": 8e-4, "stretch": 3e-4, "turn_x": 0.05, "turn_z": -0.08, "shift_y": 0.003}
NUISANCES = {
    "gain": {"kind": "gain", "columns": COLUMNS, "bounds": [0.8, 1.2], "unit": "1"},
    "zero": {"kind": "offset", "column": COLUMNS[1], "bounds": [-2e-3, 2e-3], "unit": "m"},
    "play": {"kind": "backlash", "columns": COLUMNS[:1], "bounds": [0.0, 2e-3], "unit": "m"},
    "stretch": {"kind": "compliance", "columns": COLUMNS, "bounds": [0.0, 1e-3], "unit": "m/N"},
    **{f"turn_{a}": {"kind": "frame", "part": f"turn_{a}", "bounds": [-0.3, 0.3], "unit": "rad"} for a in "xz"},
    "shift_y": {"kind": "frame", "part": "shift_y", "bounds": [-0.02, 0.02], "unit": "m"},
}


def configured(**options):
    data = {"name": "x", "robot": "finger", "data": "none", "backend": "fem", "fit": ["young_modulus"], **options}
    return check_config(CalibrationConfig, data, "test")


@pytest.fixture(scope="module")
def recorded():
    """Commands up and down in three trials, and what a finger with the drives and cameras of `TRUTH` shows."""
    robot = make_robot("finger")
    config = configured(nuisances=NUISANCES)
    up, down = np.linspace(0.001, 0.006, 6), np.linspace(0.005, 0.002, 4)
    one = np.column_stack([np.concatenate([up, down]), np.full(10, 0.002)])
    two = np.column_stack([np.full(10, 0.003), np.concatenate([up, down])])
    commands = np.concatenate([one, two, 0.5 * (one + two)])
    trial = tuple(name for name in ("left", "right", "both") for _ in range(10))
    instrument = make_instrument(TRUTH, config.nuisances, robot, "displacement")
    # Independently of the code under test: play as in environments, row by row.
    done = []
    for k, command in enumerate(commands):
        last = np.zeros(2) if k % 10 == 0 else done[-1]
        done.append(play(0.93 * command + [0.0, -6e-4], last, np.array([8e-4, 0.0])))
    np.testing.assert_allclose(instrument.driven(commands, trial)[0], done, atol=1e-15)
    backend = FEMBackend(robot)
    backend.cable_compliance = TRUTH["stretch"]
    states = [backend.step(command) for command in done]
    effort = np.array([state.effort for state in states])
    effector = instrument.seen(np.array([state.effector.ravel() for state in states]))
    return Measurements("displacement", commands, effort, effector, trial)


def test_derivatives_are_exact(recorded):
    config = configured(nuisances=NUISANCES)
    misfit = make_misfit(config, recorded, "fem")
    point = misfit.parameters.first({**TRUTH, "play": 7e-4})
    exact = misfit.jacobian(point)
    for k, name in enumerate(misfit.parameters.names):
        if name == "young_modulus":
            continue
        ends = []
        for sign in (-1.0, 1.0):
            moved = point.copy()
            moved[k] += sign * 1e-4
            ends.append(misfit.residuals(moved).copy())
        difference = (ends[1] - ends[0]) / 2e-4
        error = np.abs(difference - exact[:, k]).max() / np.abs(exact[:, k]).max()
        print(f"{name}: {error:.1e}")
        assert error < 1e-4, name


def test_known_drives_and_held_out_trials(recorded, tmp_path):
    config = configured(nuisances=NUISANCES, held_out=["both"], intervals="linear")
    noisy = recorded.with_noise(0.002, np.random.default_rng(3))
    result = calibrate(config, tmp_path / "fit", data=noisy)
    for name, true in TRUTH.items():
        low, high = result.intervals[name]
        assert low - (high - low) < true < high + (high - low), name
        assert high - low < 0.2 * (config.nuisances[name].bounds[1] - config.nuisances[name].bounds[0]), name
    assert result.held_out_states == 10 and result.measured_states == 20
    assert result.held_out_errors["effector"] < 2.0 * result.errors["effector"]
    assert result.plant["backlash"] == {"cable_1": pytest.approx(8e-4, rel=0.1), "cable_2": 0.0}
    assert result.plant["offset"]["cable_2"] == pytest.approx(-6e-4, rel=0.2)
    assert result.correlations["gain"]["gain"] == pytest.approx(1.0)
    page = (tmp_path / "fit" / "report.html").read_text()
    assert "20 states fitted, 10 held out" in page and page.count("<img") == 3
    stored = json.loads((tmp_path / "fit" / "result.json").read_text())
    assert stored["held_out_states"] == 10 and stored["plant"]["gain"]["cable_1"] == pytest.approx(0.93, rel=0.02)


def test_what_is_not_determined(recorded):
    """Without efforts, a stiffer body with cables that stretch less moves alike: only their product is known."""
    silent = replace(recorded, effort=np.full_like(recorded.effort, np.nan))
    result = calibrate(configured(nuisances=NUISANCES, intervals="linear", starts=[TRUTH]), data=silent)
    assert any("young_modulus" in note and "stretch" in note for note in result.notes)


def test_trials_in_files(recorded, tmp_path):
    robot = make_robot("finger")
    write_measurements(tmp_path / "made.csv", robot, recorded)
    found = read_measurements(tmp_path / "made.csv", robot)
    assert found.trial == recorded.trial and found.trials == ("left", "right", "both")
    np.testing.assert_array_equal(found.effector, recorded.effector)
    fitted, held_out = found.split(["right"])
    assert set(fitted.trial) == {"left", "both"} and set(held_out.trial) == {"right"}
    with pytest.raises(DataError, match="unknown trial 'middle'"):
        found.split(["middle"])
    with pytest.raises(DataError, match="nothing is left to fit"):
        found.split(["left", "right", "both"])


@pytest.mark.parametrize(
    "name, changes, message",
    [
        ("gain", {"columns": ["cable_3_displacement"]}, "unknown column 'cable_3_displacement'"),
        ("gain", {"unit": "m"}, "unit = 'm' must be '1'"),
        ("stretch", {"columns": ["cable_1_effort"]}, "unknown column 'cable_1_effort'"),
    ],
)
def test_wrong_parameters(name, changes, message):
    with pytest.raises(ValueError, match=message):
        configured(nuisances={name: {**NUISANCES[name], **changes}})


def test_parameters_that_describe_the_same():
    with pytest.raises(ValueError, match="both describe gain of cable_1_displacement; allowed: one"):
        configured(nuisances={"a": NUISANCES["gain"], "b": NUISANCES["gain"]})
    with pytest.raises(ValueError, match="needs backend 'fem', got 'surrogate'"):
        configured(nuisances={"a": NUISANCES["gain"]}, backend="surrogate")
