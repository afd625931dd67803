"""ModelBuilder: parts are combined into one model, with the specified rows and boundary conditions."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.bond import Bond
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.quadratic import add_midside_nodes
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.mechanics.solvers.statics import Statics

SIZE = (0.04, 0.01, 0.01)


@pytest.mark.parametrize("element", SOLIDS)
def test_one_solid_is_the_model_of_its_block(box, element):
    nodes, tetrahedra = box(SIZE, (4, 1, 1), 0.1)
    body = ModelBuilder(gravity=(0.0, 0.0, -9.81))
    start = body.add_solid(nodes, tetrahedra, fixed=nodes[:, 0] == 0.0, element=element, young_modulus=1e5)
    model = body.build()
    assert start == 0 and body.size == len(model.nodes)
    assert [type(block) for block in model.blocks] == [SOLIDS[element]]
    np.testing.assert_array_equal(model.nodes[: len(nodes)], nodes)
    np.testing.assert_array_equal(model.fixed, model.nodes[:, 0] == 0.0)  # midside nodes of the face, too
    direct = MechanicalModel(
        model.nodes,
        [SOLIDS[element](model.nodes, model.blocks[0].connectivity, young_modulus=1e5)],
        fixed=model.nodes[:, 0] == 0.0,
        gravity=(0.0, 0.0, -9.81),
    )
    np.testing.assert_allclose(Statics(model).solve([]).x, Statics(direct).solve([]).x, atol=1e-14)


@pytest.mark.parametrize(
    "fixed",
    [[0, 1, 3], np.array([True, True, False, True]), (np.array([1, 1, 0, 1])[:, None] * [1, 1, 1]).astype(bool)],
)
def test_fixed_nodes_by_index_by_mask_and_by_axis(fixed):
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    body = ModelBuilder()
    body.add_solid(nodes, [[0, 1, 2, 3]], fixed=fixed, element="linear")
    model = body.build()
    np.testing.assert_array_equal(model.fixed, [True, True, False, True])
    np.testing.assert_array_equal(model.kinematics.free_dofs, [6, 7, 8])


def test_midside_nodes_are_fixed_along_the_axes_of_both_ends(box):
    nodes, tetrahedra = box(SIZE, (2, 1, 1))
    mask = np.zeros((len(nodes), 3), dtype=bool)
    mask[nodes[:, 0] == 0.0, 0] = True
    mask[nodes[:, 1] == 0.0, 1] = True
    body = ModelBuilder()
    body.add_solid(nodes, tetrahedra, fixed=mask, element="quadratic")
    model = body.build()
    held = np.ones(3 * len(model.nodes), dtype=bool)
    held[model.kinematics.free_dofs] = False
    np.testing.assert_array_equal(
        held.reshape(-1, 3), np.column_stack([model.nodes[:, :2] == 0.0, 0 * model.nodes[:, 2] > 0])
    )
    assert not model.fixed.any()  # none along all axes


def test_given_quadratic_elements_are_used_unchanged(box):
    nodes, ten = add_midside_nodes(*box(SIZE, (2, 1, 1)))
    body = ModelBuilder()
    body.add_solid(nodes, ten, fixed=nodes[:, 0] == 0.0, element="quadratic")
    model = body.build()
    assert len(model.nodes) == len(nodes)
    # Some are reoriented.
    np.testing.assert_array_equal(np.sort(model.blocks[0].connectivity, axis=1), np.sort(ten, axis=1))


def composite(box, solver="auto"):
    """A block, a plate that carries its end, a beam that starts at the plate, and a block bonded to the beam."""
    nodes, tetrahedra = box(SIZE, (4, 1, 1), 0.1)
    body = ModelBuilder(gravity=(0.0, 0.0, -9.81), solver=solver)
    first = body.add_solid(
        nodes, tetrahedra, fixed=nodes[:, 0] == 0.0, element="averaged", poisson_ratio=0.49, young_modulus=1e6
    )
    plate = body.add_frame([0.04, 0.005, 0.005])
    body.carry(plate, first + np.flatnonzero(np.isclose(nodes[:, 0], 0.04)))
    frames = [plate, *(body.add_frame([0.04 + s, 0.005, 0.005]) for s in (0.01, 0.02, 0.03, 0.04))]
    body.add_element(Beam, frames, section=Section.circle(0.002), young_modulus=1e7, order=2)
    second = body.add_solid(
        nodes + [0.08, 0.0, 0.0],
        tetrahedra,
        fixed=[],
        element="quadratic",
        young_modulus=1e6,
        material="stable_neo_hookean",
    )
    model = body.build()
    assert (first, plate, second) == (0, len(nodes), len(nodes) + 20)
    spots = np.array([[0.0, 0.003, 0.003], [0.0, -0.003, 0.003], [0.0, 0.0, -0.003]])
    for k, spot in enumerate(spots):
        at = model.embed(model.nodes[frames[-1]] + spot, block=1)
        model.add("b", Bond(f"bond {k}", EmbeddedPoints.in_frame(frames[-1], spot, model.nodes), at))
    model.add("e", Point("tip", model.embed(np.array([0.12, 0.005, 0.005]), block=1)))
    return model, frames, second


@pytest.mark.parametrize("solver", ["cholmod", "superlu"])
def test_a_body_of_many_parts(box, solver):
    model, frames, second = composite(box, solver)
    assert [type(block) for block in model.blocks] == [SOLIDS["averaged"], Beam, SOLIDS["quadratic"]]
    assert len(model.solids) == 2
    assert model.mass == pytest.approx(2 * 1100 * 4e-6 + 1100 * 0.04 * np.pi * 4e-6, rel=1e-12)
    found = Statics(model, tolerance=1e-12).solve([])
    assert found.x[-1, 2] < model.nodes[-1, 2] - 1e-3  # it hangs
    # Bonds hold, and carry the weight of the second block.
    bonds = found.effort[-9:].reshape(3, 3)
    np.testing.assert_allclose(found.delta[-9:], 0.0, atol=1e-12)
    np.testing.assert_allclose(bonds.sum(axis=0), [0.0, 0.0, -1100 * 4e-6 * 9.81], atol=1e-7)
    # The clamp carries all of it.
    forces = np.zeros_like(found.x)
    for block in model.blocks:
        block.add(found.x, forces, None, None)
    held = model.fixed
    reaction = forces[held].sum(axis=0) - model.loads[held].sum(axis=0)
    np.testing.assert_allclose(reaction, [0.0, 0.0, model.mass * 9.81], atol=1e-7)


def test_a_model_can_be_pickled(box):
    model, *_ = composite(box)
    expected = Statics(model).solve([])
    again = pickle.loads(pickle.dumps(model))
    found = Statics(again).solve([])
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.condensed.compliance, expected.condensed.compliance, rtol=1e-9, atol=1e-15)


def test_unknown_names_are_rejected(box):
    nodes, tetrahedra = box(SIZE, (2, 1, 1))
    body = ModelBuilder()
    with pytest.raises(ValueError, match="unknown element 'cubic'; allowed: linear, averaged, quadratic"):
        body.add_solid(nodes, tetrahedra, fixed=[0], element="cubic")
    with pytest.raises(ValueError, match="3 is not the first row of a frame"):
        body.carry(3, np.array([0]))
    body.add_solid(nodes, tetrahedra, fixed=[0], material="jelly", element="linear")
    with pytest.raises(ValueError, match="unknown material 'jelly'"):
        body.build()
    with pytest.raises(ValueError, match="orthonormal"):
        body.add_frame([0, 0, 0], 2.0 * np.eye(3))
    nothing = ModelBuilder()
    nothing.add_solid(nodes, tetrahedra, fixed=[], element="linear")
    with pytest.raises(ValueError, match="no node is fixed"):
        nothing.build()
