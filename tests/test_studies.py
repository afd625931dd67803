"""Recording of finished studies: what goes into the tables, and what is refused."""

from __future__ import annotations

import copy
import json
import shutil

import pytest

from benchmarks.studies import study
from softgym_envs.errors import DataError
from tests.test_readme import ROOT

TESTED = {"objective": 1.6e-3, "success_rate": 0.8}
FOUND = {
    "name": "diamond_reach",
    "title": "A Diamond that reaches farther",
    "provenance": {"commit": "acb1f3575ecb"},
    "cost": {"cpu_seconds": {"trials": 60.0, "finalists": 30.0}},
    "trials": {"complete": 40},
    "trainings": [{"seed": 1}, {"seed": 2}, {"seed": 1}, {"seed": 2}],
    "winner": {"role": "finalist"},
    "variables": [
        {"name": "leg_width", "unit": "1", "optimised": True, "baseline": 1.0, "winner": 0.8, "at_limit": "lower"},
        {"name": "top_height", "unit": "m", "optimised": True, "baseline": 0.126, "winner": 0.137, "at_limit": ""},
        {"name": "young_modulus", "unit": "Pa", "optimised": False, "baseline": 1e5, "winner": 1e5, "at_limit": ""},
    ],
    "comparison": [
        {
            "backend": backend,
            "agent": agent,
            "goals": 40,
            "baseline": TESTED,
            "winner": {"objective": 6e-5, "success_rate": 1.0},
            "objective_change_interval": [-2.5e-3, -6e-4],
        }
        for backend, agent in (("fem", "policy"), ("fem", "qp"), ("surrogate", "policy"))
    ],
}


def record(folder, **changes):
    shutil.copy(ROOT / "configs" / "codesign" / "diamond_reach.yaml", folder / "config.yaml")
    (folder / "results.json").write_text(json.dumps(copy.deepcopy(FOUND) | changes))
    return study(folder)


def test_the_entry_of_a_study_has_its_finite_elements_only(tmp_path):
    name, entry = record(tmp_path)
    assert name == "diamond_reach" and entry["title"] == "Diamond" and entry["commit"] == "acb1f3575ecb"
    policy, qp = entry["rows"]
    assert policy["controller"] == "analytic gradient, a policy for each body, 2 trainings"
    assert qp["controller"] == "inverse QP"
    assert policy["baseline [mm]"] == pytest.approx(1.6) and policy["winner [mm]"] == pytest.approx(0.06)
    assert policy["change, 95% interval [mm]"] == pytest.approx([-2.5, -0.6])
    assert policy["CPU with FEM check [min]"] == pytest.approx(1.5)
    assert policy["winner's body"] == "leg width 1 → 0.8 (lower bound), top height 126 → 137 mm"


def test_studies_of_the_return_are_recorded_by_their_distances(tmp_path):
    config = (ROOT / "configs" / "codesign" / "tetrapod_carry.yaml").read_text()
    assert "objective: mean_return" in config
    (tmp_path / "config.yaml").write_text(config)
    ends = [{"objective": 1e3 * d, "mean_distance": d, "success_rate": 0.0} for d in (0.05, 0.03)]
    ends = [body | {"mean_effort": 0.2} for body in ends]
    compared = {"backend": "fem", "agent": "qp", "goals": 1, "baseline": ends[0], "winner": ends[1]}
    changes = {"objective_change_interval": None, "distance_change_interval": None, "distance_change": -0.02}
    part = {"ratio": 0.5, "before": -0.02, "left": 0.01, "interval": None}
    finer = compared | changes | {"backend": "refined", "distance_change": -0.015}
    found = copy.deepcopy(FOUND) | {"name": "tetrapod_carry", "tests": []}
    found["comparison"] = [compared | changes | {"distance_mesh": part}, finer]
    (tmp_path / "results.json").write_text(json.dumps(found))
    name, entry = study(tmp_path)
    assert name == "tetrapod_carry" and entry["title"] == "Tetrapod with 1 kg"
    assert entry["rows"][0]["baseline [mm]"] == pytest.approx(50.0)
    assert entry["rows"][0]["winner [mm]"] == pytest.approx(30.0)
    own, refined = entry["meshes"]
    assert own["winner [mm]"] == pytest.approx(30.0) and own["change [mm]"] == pytest.approx(-20.0)
    assert refined["change [mm]"] == pytest.approx(-15.0) and refined["change before [mm]"] == pytest.approx(-20.0)


def test_a_baseline_that_wins_is_said_to(tmp_path):
    assert record(tmp_path, winner={"role": "baseline"})[1]["rows"][0]["winner's body"].startswith("the baseline: none")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"provenance": {"commit": "acb1f3575ecb-dirty"}}, "clean commits only"),
        ({"provenance": {"commit": None}}, "clean commits only"),
        ({"comparison": []}, "neither baseline nor winner was tested by finite elements"),
    ],
)
def test_studies_that_nobody_can_repeat_or_trust_are_refused(tmp_path, changes, message):
    with pytest.raises(DataError, match=message):
        record(tmp_path, **changes)


def test_unfinished_studies_are_refused(tmp_path):
    with pytest.raises(DataError, match="a study writes it when it has finished"):
        study(tmp_path)


def test_the_entry_of_a_study_on_two_meshes_has_both(tmp_path):
    part = {"goals": 3, "ratio": 0.5, "before": -1.59e-3, "left": 1e-4, "left_interval": [0.0, 2e-4]}
    part["interval"] = [-2.5e-3, -4e-4]
    body = {"objective": 1.6e-3, "success_rate": 0.8, "mean_effort": 2.0}
    rows = [
        {
            "backend": backend,
            "agent": "policy",
            "goals": goals,
            "baseline": body,
            "winner": {**body, "objective": 6e-5},
            "objective_change": -1.54e-3,
            "objective_change_interval": [-2.5e-3, -6e-4] if goals > 5 else None,
            "objective_mesh": part if backend == "fem" else None,
        }
        for backend, goals in (("fem", 20), ("refined", 3), ("surrogate", 20))
    ]
    tests = [{"backend": "fem", "unknowns": 27000}, {"backend": "refined", "unknowns": 55000}]
    _, entry = record(tmp_path, comparison=rows, tests=tests)
    assert len(entry["rows"]) == 1
    assert entry["rows"][0]["change with the mesh, 95% interval [mm]"] == pytest.approx([-2.5, -0.4])
    assert [row["judge"] for row in entry["meshes"]] == [
        "finite elements",
        "finite elements, finer mesh",
        "surrogate",
    ]
    assert [row["unknowns"] for row in entry["meshes"]] == [27000, 55000, None]
    assert [row["interval [mm]"] is None for row in entry["meshes"]] == [False, True, False]
    assert entry["meshes"][0]["with the mesh [mm]"] == pytest.approx([-2.5, -0.4])
    assert entry["meshes"][1]["change before [mm]"] == pytest.approx(-1.59)
