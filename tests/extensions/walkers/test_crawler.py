"""The crawler: sections and chambers against theory, and bodies over the whole design box in compiled code."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.extensions.beams.beam import Beam
from softgym_envs.extensions.walkers.robots.crawler import (
    CHAMBER_HEIGHT,
    CHAMBER_WIDTH,
    LAYER,
    LAYER_MODULUS,
    layered,
    neutral_height,
)
from tests.extensions.walkers.driving import bodies_in_motion


@pytest.fixture(scope="module")
def robot():
    return make_robot("crawler")


def test_the_section_is_that_of_two_bonded_layers():
    width, height, modulus = 0.013, 0.009, 7e4
    z = (np.arange(90_000) + 0.5) * height / 90_000
    young = np.where(z < LAYER, LAYER_MODULUS, modulus)
    axis = (young * z).sum() / young.sum()
    assert neutral_height(height, modulus) == pytest.approx(axis, rel=1e-6)
    stretch, _, _, _, bend, turn = layered(width, height, modulus).stiffness(modulus, 0.45)
    assert stretch == pytest.approx(width * height * young.mean(), rel=1e-6)
    assert bend == pytest.approx(width * height * (young * (z - axis) ** 2).mean(), rel=1e-6)
    assert turn == pytest.approx(stretch * width**2 / 12.0, rel=1e-9)
    alike = layered(width, height, LAYER_MODULUS)  # of one material
    assert alike.inertia[0] == pytest.approx(width * height**3 / 12.0)


def test_chambers_bend_their_parts_downwards_by_their_moment():
    """Without weight: angle and pressure of a beam bent by a chamber at a distance from its axis."""
    robot = make_robot("crawler", gravity=(0.0, 0.0, 0.0), elements=8)
    backend = FEMBackend(robot, dynamics=True)
    model, design = backend.model, robot.design_space.baseline
    legs = [block for block in model.blocks if isinstance(block, Beam)][1:]
    height, width = design["height"], design["leg_width"]
    arm = 0.5 * height - neutral_height(height, design["young_modulus"])
    area, volume = CHAMBER_WIDTH * width * CHAMBER_HEIGHT * height, 1e-7
    command = np.array([0.0, *4 * [volume]])
    for k in range(40):
        state = backend.step(min(1.0, (k + 1) / 20) * command)
    stiffness = legs[0].element_stiffness[0]
    # The chamber stretches its line by turning about the axis, and the axis a little.
    share = arm**2 / stiffness[4] + 1.0 / stiffness[0]
    moment = volume / area / design["leg_length"] / share * arm
    angle = moment * design["leg_length"] / stiffness[4]
    for leg in legs:
        root, tip = state.nodes[leg.chain[0] + 1], state.nodes[leg.chain[-1] + 1]
        assert np.arccos(root @ tip / np.linalg.norm(root) / np.linalg.norm(tip)) == pytest.approx(angle, rel=0.02)
        assert tip[2] < root[2]
    assert state.effort[1:] == pytest.approx(moment / (area * arm), rel=0.02)
    assert abs(state.effort[0]) < 0.02 * state.effort[1]


def test_mass_is_that_of_the_published_scene(robot):
    assert robot.build().mass == pytest.approx(0.035, rel=0.02)


def test_every_body_lies_and_moves_in_compiled_code(robot):
    backend = FEMBackend(robot, dynamics=True)
    for _ in bodies_in_motion(backend):
        for _ in range(10):
            state = backend.step(np.zeros(5))
        weight = 9.81 * backend.model.mass
        assert state.contacts.total[0] == pytest.approx([0.0, 0.0, weight], abs=1e-4 * weight)
        assert np.abs(state.velocity).max() < 1e-4


def test_the_common_gait_goes_straight_and_the_same_one_backwards_goes_back(robot):
    backend, gait = FEMBackend(robot, dynamics=True), robot.reference_gait()
    assert (np.abs(np.diff(gait, axis=0, append=gait[:1])) <= robot.rates).all()
    ways = []
    for each in (gait, gait[::-1]):
        backend.reset()
        states = [backend.step(each[k % len(each)] * min(1.0, k / 10)) for k in range(100)]
        ways.append(states[-1].effector[0] - states[49].effector[0])
    assert ways[0][0] > 2e-3 and ways[1][0] < -2e-3
    assert np.abs([ways[0][1], ways[1][1]]).max() < 2e-4


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"friction": 0.0}, "friction = 0.0 must be finite and positive"),
        ({"elements": 3}, "elements = 3 is out of bounds; allowed: even integers from 2"),
    ],
)
def test_wrong_options(options, words):
    with pytest.raises(ValueError, match=words):
        make_robot("crawler", **options)
