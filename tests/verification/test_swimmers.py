"""Swimmers against resistive force theory with prescribed curvature, and that against a formula."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.extensions.walkers.fluid import slender_drag
from softgym_envs.extensions.walkers.robots.swimmer import PERIOD, SEGMENTS
from softgym_envs.extensions.walkers.robots.tapered import CHAMBER_OFFSET, CHAMBER_RADIUS
from tests.verification.swimmers import swim


def test_long_waves_swim_as_gray_and_hancock_found():
    """Speed b^2 k w (C_n - C_t) / (2 C_t + b^2 k^2 C_n), which ends of the body lower like one over their number."""
    along, across, slope = 1.0, 1.9, 0.1
    gaps = []
    for waves in (2, 4, 8):
        k, w = 2.0 * math.pi * waves, 2.0 * math.pi
        curvature = lambda s, time, k=k, w=w: slope * k * np.sin(k * s - w * time)  # noqa: E731
        places = swim(curvature, 1.0, (along, across), np.linspace(0.0, 2.0, 81))
        speed = np.linalg.norm(places[80] - places[40])  # per period
        gaps.append(1.0 - speed / (w / k * slope**2 * (across - along) / (2.0 * along + slope**2 * across)))
    assert (np.diff(gaps) < 0.0).all()
    assert 0.0 < gaps[-1] < 0.02


def test_the_swimmer_is_that_of_prescribed_curvature():
    """Stiff chambers impose the shape, and the fluid is so viscous that the body's own inertia does not count."""
    viscosity = 10.0
    robot = make_robot("swimmer", elements=2, viscosity=viscosity)
    design = robot.design_space.complete({"young_modulus": 5e5})
    length, radius, taper = design["length"], design["radius"], design["taper"]
    backend = FEMBackend(robot, design, dynamics=True)
    times = 0.05 * np.arange(2 * PERIOD + 1)
    rise = np.minimum(np.arange(len(times)) / 10.0, 1.0)
    commands = rise[:, None] * np.roll(np.tile(robot.reference_gait(), (3, 1)), 1, axis=0)[: len(times)]
    places = np.array(
        [robot.place(backend.reset(design).nodes), *(robot.place(backend.step(c).nodes) for c in commands[1:])]
    )
    bent, thin = (1.0 - design["tail"]) * length / SEGMENTS, radius * taper
    gain = 1.0 / (CHAMBER_OFFSET * thin * math.pi * (CHAMBER_RADIUS * thin) ** 2)

    def curvature(s, time):
        turns = [gain * np.interp(time, times, commands[:, 2 * k]) for k in range(SEGMENTS)]
        return np.array([*turns, 0.0])[np.minimum(s / bent, SEGMENTS).astype(int)] / bent

    expected = swim(curvature, length, slender_drag(viscosity, length, 0.5 * radius * (1.0 + taper)), times)
    way = expected[-1, 0] - expected[0, 0]
    assert way > 5e-3
    assert places[PERIOD, 0] - places[0, 0] == pytest.approx(expected[PERIOD, 0] - expected[0, 0], rel=0.02)
    assert places[-1, 0] - places[0, 0] == pytest.approx(way, rel=0.02)
    assert places[:, 1] == pytest.approx(expected[:, 1], abs=0.02 * way)
