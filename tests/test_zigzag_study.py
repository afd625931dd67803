"""Designs chosen from the front of a search, and what is written about them."""

import json
from pathlib import Path

import numpy as np
from click.testing import CliRunner

from benchmarks import zigzag_study
from benchmarks.zigzag_designs import DESIGNS
from softgym_envs.codesign.tools.config import OptimiseConfig
from softgym_envs.codesign.tools.records import FrontDesign
from softgym_envs.config import load_config, save_resolved
from softgym_envs.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.storage import write_json

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "design" / "contact_aided_finger_front.yaml"
ROBOT = ContactAidedFinger()


def front_design(trial, name, force, energy, resistance):
    metrics = {"grip_force": force, "grip_energy": energy, "grip_resistance": resistance}
    return FrontDesign(trial=trial, design=dict(ROBOT.design_space.complete(DESIGNS[name])), metrics=metrics)


FRONT = [
    front_design(0, "A", 0.5, 0.4, 0.16),
    front_design(1, "B", 2.7, 0.9, 0.076),
    front_design(2, "203", 2.0, 0.5, 0.08),
]


def test_chosen_designs():
    chosen = zigzag_study.winners(FRONT)
    assert {name: each.trial for name, each in chosen.items()} == {
        "best force": 1,
        "best energy": 0,
        "best resistance": 1,
        "compromise": 2,
    }


def test_a_front_of_one_design_is_all_of_them():
    assert {each.trial for each in zigzag_study.winners(FRONT[1:2]).values()} == {1}


def test_command_writes_files_to_print_and_continues(tmp_path, monkeypatch):
    evaluated = []

    def evaluate(name, design, mesh):
        evaluated.append((name, mesh))
        return zigzag_study.Value(name, mesh, "ok", 100, 1.0 + len(evaluated), 0.1, 0.5)

    monkeypatch.setattr(zigzag_study, "evaluate", evaluate)
    monkeypatch.setattr(zigzag_study, "DESIGNS", {"B": DESIGNS["B"]})
    save_resolved(tmp_path, load_config(CONFIG, OptimiseConfig))
    counts = {"feasible": 3, "infeasible": 0, "repeated": 0, "busy_seconds": 1.0}
    write_json(tmp_path / "result.json", {"front": [each.to_json() for each in FRONT], **counts})
    rows = [f"{k},1.0,0.5,0.1" for k in range(3)]
    (tmp_path / "trials.csv").write_text("\n".join(["trial,grip_force,grip_energy,grip_resistance", *rows]))
    results = [CliRunner().invoke(zigzag_study.main, [str(tmp_path)], catch_exceptions=False) for _ in range(2)]
    assert len(evaluated) == 3 * 2  # B is the best in two objectives
    shown = json.loads(results[1].output)
    assert shown["search"]["front"] == 3 and shown["values"][0]["force"] == 2.0
    assert (tmp_path / "print" / "best_force.step").read_text().startswith("ISO-10303-21")
    assert (tmp_path / "print" / "compromise.stl").stat().st_size > 1000
    assert (tmp_path / "chosen.png").read_bytes().startswith(b"\x89PNG")


def test_values_of_one_design(monkeypatch):
    monkeypatch.setitem(zigzag_study.MESHES, "coarse", {"mesh_size": 40e-3})
    monkeypatch.setattr(zigzag_study, "ContactAidedFinger", lambda **options: seen.append(options) or ROBOT)
    seen = []
    curve = type("G", (), {"reason": "", "status": "ok", "nodes": 9, "contact_force": 2.0, "grasp_resistance": np.inf})
    curve.grasp_energy = 0.3
    monkeypatch.setattr(zigzag_study, "evaluate_grasp", lambda robot, design: curve)
    value = zigzag_study.evaluate("A", DESIGNS["A"], "coarse")
    assert seen == [{"mesh_size": 40e-3}]
    assert (value.force, value.energy, value.status) == (2.0, 0.3, "ok")
