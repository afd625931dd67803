"""The convergence benchmark: extrapolation, and one study from levels to its table."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import convergence, convergence_tables
from benchmarks.run import matching
from softgym_envs.errors import ConfigError
from softgym_envs.surrogate.correction import HIGHEST_ORDER, LOWEST_ORDER


@pytest.mark.parametrize("order", [0.8, 1.0, 2.0, 3.5])
def test_extrapolation_is_exact_for_one_power_of_the_size(order):
    sizes = (1.0, 0.5, 1.0 / 3.0)
    found, limit = convergence.order_and_limit([2.0 + 0.3 * h**order for h in sizes], sizes)
    assert found == pytest.approx(order, rel=1e-9) and limit == pytest.approx(2.0, rel=1e-9)
    direction = np.array([0.1, -0.4, 0.2])
    found, limit = convergence.order_and_limit([np.ones(3) + direction * h**order for h in sizes], sizes)
    assert found == pytest.approx(order, rel=1e-9) and np.allclose(limit, 1.0, rtol=0.0, atol=1e-9)


def test_the_order_stays_within_its_bounds():
    sizes = (1.0, 0.5, 0.25)
    assert convergence.order_and_limit([3.0, 2.0, 2.0], sizes) == (HIGHEST_ORDER, 2.0)
    order, limit = convergence.order_and_limit([2.2, 2.1, 2.0], sizes)  # differences that do not shrink
    assert order == LOWEST_ORDER
    assert limit == pytest.approx(2.0 - 0.1 / (2.0**0.5 - 1.0))


def test_a_study_of_the_trunk_converges(monkeypatch):
    monkeypatch.setattr(convergence, "BODIES", 1)
    found = convergence.converge("trunk")
    assert [row["mesh"] for row in found["rows"]] == ["published", "accurate", "reference"] * 2
    for body in found["errors"].values():
        tips = [body["meshes"][mesh]["tip"] for mesh in ("published", "accurate", "reference")]
        assert tips[2] < tips[1] < tips[0] < 0.01
    known = {"convergence_trunk": {"results": found}}
    monkeypatch.setattr(convergence_tables, "records", lambda: known)
    monkeypatch.setattr(convergence_tables, "results", lambda name: known[name]["results"])
    lines = convergence_tables.convergence().splitlines()
    assert len(lines) == 5 and lines[2].startswith("| Stiff-Flop trunk | published |")
    assert len(convergence_tables.convergence_limits().splitlines()) == 3
    picture = convergence_tables.draw()
    assert picture.ndim == 3 and picture.std() > 1.0


def test_a_body_without_equilibrium_is_a_row_with_its_reason(monkeypatch):
    study = replace(convergence.STUDIES["trunk"], command=(math.nan,) * 6)
    robot = convergence.make_robot("trunk")
    monkeypatch.setattr(convergence.Statics, "solve", fail)
    row = convergence.measure(robot, robot.design_space.baseline, "baseline", "accurate", study)
    assert row.failure == "no equilibrium" and math.isnan(row.effort)
    assert convergence.errors([row], ["accurate"], (1.0, 0.5, 0.25)) == {}


def fail(self, command):
    raise convergence.ConvergenceError("no equilibrium")


def test_a_name_stands_for_all_benchmarks_that_begin_with_it():
    assert matching("convergence") == list(convergence.BENCHMARKS)
    assert matching("contact") == ["contact"]
    with pytest.raises(ConfigError, match="convergance"):
        matching("convergance")
