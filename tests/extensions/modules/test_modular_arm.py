"""The modular arm on superelements against finite elements of its whole body."""

import gymnasium
import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import DesignError, InfeasibleDesign
from softgym_envs.extensions.deployment.cad import export_body
from softgym_envs.extensions.modules.modular_arm import BODIES, CELLS
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.domain import distrust_text
from tests.verification.modular_arm import ExactArm


@pytest.mark.parametrize(
    ("cells", "command"),
    [
        (["leaf_x", "leaf_y"], [0.002, 0.001]),
        (["notch_x", "notch_y"], [0.002, 0.001]),
        (["tube"], [0.002, 0.001]),
        (["accordion"], [0.002, 0.001]),
    ],
)
def test_the_modular_arm_follows_finite_elements_of_the_whole_body(cells, command):
    found = {}
    for body in ("superelements", "solid"):
        robot = make_robot("modular_arm", cells=cells, body=body)
        found[body] = Statics(robot.build()).solve(np.array(command)).condensed
    moved = found["solid"].delta.e - robot.effector_rest
    assert np.linalg.norm(moved) > 0.002
    assert np.linalg.norm(found["superelements"].delta.e - found["solid"].delta.e) < 0.01 * np.linalg.norm(moved)


def test_an_arm_of_exact_energies_has_the_states_of_finite_elements_of_the_whole_body():
    """So errors of an arm of superelements are errors of its learned energies: neither ports nor meshes add any."""
    cells, command = ("leaf_y", "notch_x"), np.array([0.002, -0.001])
    design = make_robot("modular_arm", cells=cells).design_space.complete({"young_modulus": 3e7})
    models = {body: make_robot("modular_arm", cells=cells, body=body).build(design) for body in BODIES}
    true, learned = (Statics(models[body]).solve(command).condensed for body in ("solid", "superelements"))
    found = ExactArm(cells, design).solve(command, Statics(models["superelements"]).solve(command))[0].condensed
    np.testing.assert_allclose(found.delta.e, true.delta.e, atol=1e-8)
    np.testing.assert_allclose(found.compliance, true.compliance, rtol=1e-4, atol=1e-7)
    assert np.abs(learned.delta.e - true.delta.e).max() > 1e-7


def test_the_arm_sinks_under_its_weight_as_finite_elements_do():
    """Weight across a leaf that carries a block, within the loads that were learned."""
    found = {}
    for body in ("superelements", "solid"):
        robot = make_robot("modular_arm", cells=["leaf_x", "block"], body=body, gravity=(4.0, 0.0, 0.0))
        solver = Statics(robot.build())
        found[body] = solver.solve(np.zeros(2), "effort").condensed.delta.e - robot.effector_rest
    assert found["solid"][0] > 5e-4
    assert found["superelements"][0] == pytest.approx(found["solid"][0], rel=0.02)


def test_the_arm_knows_how_far_its_tip_may_be_off():
    """Larger far from rest; the tip on finite elements of the whole body is within it."""
    robots = {body: make_robot("modular_arm", cells=["leaf_x", "notch_y"], body=body) for body in BODIES}
    backend = FEMBackend(robots["superelements"])
    assert backend.state.uncertainty < 1e-6
    sizes = []
    for share in (0.5, 1.0):
        state = backend.step(share * np.array([0.003, 0.002]))
        sizes.append(state.uncertainty)
        solid = Statics(robots["solid"].build()).solve(share * np.array([0.003, 0.002])).condensed.delta.e
        assert np.linalg.norm(state.effector[0] - solid) < state.uncertainty
    assert 0.0 < sizes[0] < sizes[1] < robots["solid"].goal_tolerance
    assert FEMBackend(robots["solid"]).state.uncertainty == 0.0


def test_the_compliance_of_the_arm_is_the_derivative_of_its_equilibria():
    model = make_robot("modular_arm").build()
    solver, command, step = Statics(model), np.array([0.004, 0.001]), 1e-6
    W = solver.solve(command).condensed.W
    moves = [solver.solve(command + s * step * np.eye(2)[0]).condensed.delta.e for s in (1.0, -1.0)]
    held = W.ea @ np.linalg.inv(W.aa)
    np.testing.assert_allclose((moves[0] - moves[1]) / (2.0 * step), held[:, 0], rtol=1e-3, atol=1e-4)


def test_an_arm_that_buckles_is_told_and_not_trusted():
    """A wire bends a leaf about its stiff axis until it buckles sideways, as on finite elements.

    The wires hold the state: the compliance with the wires held is positive definite, that under given forces is not.
    """
    command = np.array([0.002, 0.0005])
    for body in BODIES:
        robot = make_robot("modular_arm", cells=["leaf_x", "block"], body=body, max_effort=10.0)
        backend = FEMBackend(robot)
        before = backend.step(np.array([0.002, 0.00025]))
        state = backend.step(command)
        np.testing.assert_allclose(state.displacement, command, atol=1e-6)
        assert before.stable and not state.stable
        for found, definite in ((before, True), (state, False)):
            W = found.condensed.W
            assert (np.linalg.eigvalsh(W.aa)[0] > 0.0) == definite
            assert np.linalg.eigvalsh(W.ee - W.ea @ np.linalg.solve(W.aa, W.ae))[0] > 0.0
        assert state.trusted == (body == "solid")
        assert ("softening" in distrust_text(state.distrust)) == (body == "superelements")


def test_the_compliance_of_any_arm_is_positive_definite_where_it_is_stable():
    """Random structures, dimensions and commands: at rest, and wherever the modules know their loads."""
    kinds = [kind for kind in CELLS if kind != "bellows"]
    robot, rng = make_robot("modular_arm", cells=5, kinds=kinds), np.random.default_rng(2)
    stable = []
    for _ in range(12):
        design = dict(robot.design_space.sample(rng))
        design = design | {f"kind_{number}": float(rng.integers(len(kinds))) + 0.5 for number in range(1, 6)}
        solver = Statics(robot.build(design))
        for share in (0.0, 1.0):
            state = solver.solve(share * rng.uniform(-0.003, 0.003, 2))
            known = all(block.knows(state.x) for block in solver.model.blocks)
            if known or state.stable:
                assert state.stable and np.linalg.eigvalsh(state.condensed.compliance)[0] > 0.0
            assert known or share
            stable.append(state.stable)
    assert sum(stable) > 18


def test_cells_are_an_option_and_their_dimensions_the_design():
    robot = make_robot("modular_arm", cells=["block", "leaf_y", "leaf_x"])
    assert "depth_1" in robot.design_space.names and "thickness_3" in robot.design_space.names
    model = robot.build({"length_1": 0.03})
    assert model.constraints["e"][0].value(model.nodes)[2] == pytest.approx(robot.effector_rest[2] + 0.01)
    assert robot.mechanics_key["cells"] == ["block", "leaf_y", "leaf_x"]
    with pytest.raises(DesignError, match="leaf_length_2"):
        robot.build({"leaf_length_2": 0.05})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cells": ["leaf_z"]}, "unknown cell 'leaf_z'"),
        ({"cells": []}, "list of names"),
        ({"cells": True}, "cells = True must be a list of strings or an integer"),
        ({"cells": 13}, "cells = 13 is out of bounds; allowed: 1 to 12"),
        ({"cells": 2.5}, "cells = 2.5 must be a list of strings or an integer"),
        ({"body": "fem"}, "'fem'"),
        ({"cells": 2, "kinds": ["leaf"]}, "unknown kind 'leaf'"),
        ({"cells": 2, "kinds": []}, "kinds must be a list of names"),
    ],
)
def test_wrong_options_of_the_arm_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        make_robot("modular_arm", **options)


def test_shares_and_choices_have_no_unit():
    arm = make_robot("modular_arm", cells=2)
    with pytest.raises(DesignError, match=r"'kind_1' = 7 is out of bounds; allowed: 0 to 4$"):
        arm.design_space.complete({"kind_1": 7})
    with pytest.raises(DesignError, match=r"'length_1' = 2 is out of bounds; allowed: 0 to 1$"):
        arm.design_space.complete({"length_1": 2})


def test_the_structure_may_be_part_of_the_design():
    """The baseline is the arm of the same leaves; cells can be left out, but not all; shares span learned ranges."""
    free, fixed = make_robot("modular_arm", cells=4), make_robot("modular_arm")
    assert free.kinds() == fixed.cells
    tips = [Statics(robot.build()).solve(np.array([0.004, -0.002])).delta[2:] for robot in (free, fixed)]
    np.testing.assert_allclose(*tips, atol=1e-9)
    design = {
        "kind_1": 2.0,
        "kind_2": 0.0,
        "kind_3": 3.9,
        "kind_4": 4.0,
        "length_1": 0.0,
        "depth_1": 1.0,
        "length_2": 1.0,
    }
    assert free.kinds(design) == ("block", "leaf_x", "none", "none")
    same = make_robot("modular_arm", cells=["block", "leaf_x"])
    sizes = {"length_1": 0.010, "width_1": 0.020, "depth_1": 0.020, "leaf_length_2": 0.025}
    tips = [
        Statics(robot.build(d)).solve(np.array([0.002, 0.0])).delta[2:] for robot, d in ((free, design), (same, sizes))
    ]
    np.testing.assert_allclose(*tips, atol=1e-9)
    with pytest.raises(InfeasibleDesign, match="all cells of the arm are left out"):
        free.build({f"kind_{k}": 3.5 for k in range(1, 5)})


def test_the_kinds_of_free_cells_are_an_option():
    """The baseline takes turns of the first two kinds; every kind has its own picture."""
    robot = make_robot("modular_arm", cells=5, kinds=["accordion", "notch_y", "tube", "notch_x"])
    assert robot.kinds() == ("accordion", "notch_y") * 2 + ("accordion",)
    design = {f"kind_{number}": number - 1.0 for number in range(1, 6)}
    assert robot.kinds(design) == ("accordion", "notch_y", "tube", "notch_x", "none")
    model = robot.build({**design, "length_3": 1.0, "depth_2": 0.0})
    same = make_robot("modular_arm", cells=["accordion", "notch_y", "tube", "notch_x"])
    lengths = [model.constraints["e"][0].value(model.nodes)[2] for model in (model, same.build({"length_3": 0.04}))]
    assert lengths[0] == pytest.approx(lengths[1])
    assert len(model.skins) == 5 + 4
    assert make_robot("modular_arm", cells=2, kinds=["tube"]).kinds() == ("tube", "tube")


def test_loads_that_were_not_learned_are_told():
    """A leaf that is bent about its stiff axis carries 68 times the largest load that it was learned under."""
    usual, bent = ({"cells": cells} for cells in (["leaf_x", "leaf_y"], ["leaf_x", "block"]))
    for options, command, trusted in ((usual, [0.002, 0.001], True), (bent, [0.0, 0.002], False)):
        env = gymnasium.make("SoftGym/ModularReach-v0", robot_options=options)
        _, info = env.reset(seed=0)
        assert info["trusted"]
        state = env.unwrapped.backend.step(np.array(command))
        assert state.trusted == trusted and (state.distrust == 0) == trusted
    assert "loads" in distrust_text(state.distrust)
    solid = FEMBackend(make_robot("modular_arm", body="solid", **bent))
    assert solid.step(np.array([0.0, 0.002])).trusted


def test_environments_draw_structures():
    env = gymnasium.make("SoftGym/ModularReach-v0", robot_options={"cells": 3}, sample_design=True)
    structures = set()
    for seed in range(6):
        env.reset(seed=seed)
        structures.add(env.unwrapped.robot.kinds(env.unwrapped.design))
        observation, *_ = env.step(env.action_space.sample())
        assert np.isfinite(observation).all()
    assert len(structures) > 3


def test_the_arm_is_written_as_its_solid_body(tmp_path):
    path = export_body(make_robot("modular_arm", cells=2), tmp_path / "arm.stl", {"kind_1": 2.5})
    assert path.stat().st_size > 10_000
    assert make_robot("modular_arm", cells=2).printable().body == "solid"
