"""Random contact-aided fingers are closed, kept and counted."""

import math

from benchmarks import zigzag_closing
from benchmarks.zigzag_closing import close_random, outcomes, random_design
from softgym_envs.robots.contact_aided_finger import ContactAidedFinger

COARSE = {"element": "linear", "mesh_size": 0.012}


def test_random_designs_are_repeatable_and_complete():
    assert random_design(3) == random_design(3) != random_design(4)
    assert len(random_design(3)) == 15
    ContactAidedFinger().design_space.complete(random_design(3))


def test_closings_are_kept_and_gaps_stay_open(tmp_path, monkeypatch):
    (row,) = close_random(1, tmp_path, 4, COARSE)
    assert row["status"] in ("ok", "infeasible", "no equilibrium")
    assert row["gap"] > 0.0
    monkeypatch.setattr(zigzag_closing, "evaluate_grasp", lambda *_, **__: 1 / 0)
    assert close_random(1, tmp_path, 4, COARSE) == [row]


def test_failures_are_told_from_infeasible_bodies_and_from_strong_ones():
    row = {"status": "ok", "limited": False, "gap": 2e-4, "iterations": 50, "cpu_seconds": 2.0}
    rows = [
        row,
        row | {"limited": True, "cpu_seconds": 4.0},
        row | {"status": "infeasible", "gap": math.inf, "iterations": 0},
        row | {"status": "no equilibrium", "gap": 1e-4, "iterations": 90},
    ]
    found = outcomes(rows)
    assert [found[key] for key in ("closed", "closed until the largest torque", "infeasible", "no equilibrium")] == [
        1,
        1,
        1,
        1,
    ]
    assert found["smallest gap [mm]"] == 0.1
    assert found["CPU, median and largest [s]"] == [3.0, 4.0]
    assert found["iterations, largest"] == 90
