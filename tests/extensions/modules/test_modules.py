"""Compliant modules against beam theory, and structures of them against finite elements of the whole body."""

import math

import numpy as np
import pytest

from softgym_envs.errors import DesignError
from softgym_envs.extensions.deployment.cad import write_drawing
from softgym_envs.extensions.modules import MODULES
from softgym_envs.extensions.modules.base import DENSITY

E = 1.0e7
NO_POISSON = {"young_modulus": E, "poisson_ratio": 0.0}  # then clamped ends do not stiffen a beam
X, Y, Z, RX, RY, RZ = range(6)


def turned(angle):
    """Rotation about z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("name", MODULES)
def test_every_module_is_stable_and_its_mesh_fills_it(name):
    module = MODULES[name]()
    compliance = module.compliance()
    np.testing.assert_allclose(compliance, compliance.T, atol=1e-9 * abs(compliance).max())
    assert np.linalg.eigvalsh(compliance).min() > 0.0
    heights = module.body().nodes[:, 2]
    complete = module.design_space.complete()
    np.testing.assert_allclose([heights.min(), heights.max()], [0.0, module.length(complete)], atol=1e-9)


@pytest.mark.parametrize("name", MODULES)
def test_stiffness_is_proportional_to_the_modulus(name):
    module = MODULES[name]()
    soft, hard = (module.compliance({"young_modulus": value}) for value in (1e6, 4e6))
    np.testing.assert_allclose(soft, 4.0 * hard, rtol=1e-6, atol=1e-9 * abs(soft).max())


@pytest.mark.parametrize("name", MODULES)
def test_wrong_designs_are_named(name):
    with pytest.raises(DesignError, match="young_modulus"):
        MODULES[name]().compliance({"young_modulus": -1.0})


def test_a_block_obeys_beam_theory():
    length, depth, width = 0.060, 0.006, 0.008
    found = MODULES["solid_block"]().compliance({"length": length, "depth": depth, "width": width, **NO_POISSON})
    area = depth * width
    # Pure tension and pure bending are exact with nu = 0; bending by a force has shear as well (Timoshenko, 5/6).
    for force, turn, about, size in ((X, RY, width * depth**3, 1.0), (Y, RX, depth * width**3, -1.0)):
        bending = length / (E * about / 12.0)
        shear = length / (5.0 / 6.0 * 0.5 * E * area)
        assert found[turn, turn] == pytest.approx(bending, rel=1e-3)
        assert found[force, turn] == pytest.approx(size * bending * length / 2.0, rel=1e-3)
        assert found[force, force] == pytest.approx(bending * length**2 / 3.0 + shear, rel=3e-3)
    assert found[Z, Z] == pytest.approx(length / (E * area), rel=1e-6)


def test_a_tube_twists_by_bredt():
    radius, wall, length = 0.010, 0.003, 0.040
    design = {"radius": radius, "wall": wall, "length": length, "young_modulus": E, "poisson_ratio": 0.3}
    polar = 0.5 * math.pi * (radius**4 - (radius - wall) ** 4)
    exact = length / (E / 2.6 * polar)
    tube = MODULES["torsion_tube"]()
    errors = [tube.compliance(design, refine=refine)[RZ, RZ] / exact - 1.0 for refine in (1.0, 2.0)]
    # The sides of the elements are straight: the error of the wall falls with the square of their size.
    assert 0.0 < errors[1] < 0.4 * errors[0] < 0.03


def test_a_leaf_bends_like_a_beam():
    width, thickness = 0.010, 0.0015
    short, long = (
        MODULES["leaf_spring"]().compliance(
            {"leaf_length": length, "width": width, "thickness": thickness, **NO_POISSON}, refine=1.5
        )
        for length in (0.020, 0.035)
    )
    # The plates give way a little where the leaf begins, by the same amount for both.
    bending = 0.015 / (E * width * thickness**3 / 12.0)
    assert long[RY, RY] - short[RY, RY] == pytest.approx(bending, rel=0.005)
    assert bending / 15.0 * 20.0 < short[RY, RY] < 1.06 * bending / 15.0 * 20.0
    assert long[RX, RX] < 0.05 * long[RY, RY]


def test_crossed_leaves_turn_about_their_crossing():
    length, width, thickness = 0.030, 0.020, 0.001
    module = MODULES["crossed_leaves"]()
    design = {"leaf_length": length, "width": width, "thickness": thickness, **NO_POISSON}
    found = module.compliance(design)
    # A torque bends each leaf to an arc; the gaps between the leaves are two thicknesses in all.
    bending = length / (E * (width - 2.0 * thickness) * thickness**3 / 12.0)
    assert found[RY, RY] == pytest.approx(bending, rel=0.04)
    # So the far port turns about the crossing, in the middle of the module.
    middle = 0.5 * module.length(module.design_space.complete(design))
    assert found[X, RY] / found[RY, RY] == pytest.approx(middle, rel=0.01)


@pytest.mark.parametrize(("neck", "within"), [(0.002, 0.02), (0.0012, 0.01)])
def test_a_notch_turns_like_a_beam_of_varying_depth(neck, within):
    """Against beam theory and its correction of second order in the slope of the depth, which has no fitted numbers.

    Under a moment alone, Airy's function of a strip of depth h(z) begins with the cubic in x that is constant, with no
    slope, along both notches. Its energy, to second order in the slope, is ``(1 + 0.3 h'^2) / h^3`` per length where
    that of a beam is ``1 / h^3``. Near a neck t between circles of radius r, h is ``t + z^2 / r``, and the slope adds
    0.4 t/r to the turn. What is left out is of the order of (t/r)^2.
    """
    width, radius, module = 0.005, 0.008, MODULES["notch_hinge"]()
    design = {"radius": radius, "neck": neck, "width": width, **NO_POISSON}
    blocks = module.length(module.design_space.complete(design)) - 2.0 * radius
    found = module.compliance(design)[RY, RY] - 12.0 * blocks / (E * width * (neck + 2.0 * radius) ** 3)
    z = np.linspace(-radius, radius, 20001)
    depth = neck + 2.0 * (radius - np.sqrt(np.maximum(radius**2 - z**2, 0.0)))
    beam = 12.0 / (E * width) * np.trapezoid(1.0 / depth**3, z)
    # The integral has a closed form in the limit of thin necks.
    thin = 9.0 * math.pi * math.sqrt(radius) / (2.0 * E * width * neck**2.5)
    ratio = neck / radius
    assert beam == pytest.approx(thin * (1.0 - 0.125 * ratio), rel=0.02 * ratio)
    assert found == pytest.approx(beam * (1.0 + 0.4 * ratio), rel=within)
    assert found > beam * (1.0 + 0.3 * ratio)  # beam theory alone is told apart


def test_an_accordion_stretches_by_bending_its_folds():
    folds, pitch, amplitude, width, thickness = 3, 0.015, 0.008, 0.010, 0.0008
    module = MODULES["accordion"]()
    design = {"folds": folds, "pitch": pitch, "amplitude": amplitude, "width": width, "thickness": thickness}
    found = module.compliance({**design, **NO_POISSON}, refine=0.7)
    # Castigliano: the moment is the force times x. Two walls are one before the corner, so bending ends there.
    side = math.hypot(2.0 * amplitude, 0.5 * pitch)
    stiffness = E * width * thickness**3 / 12.0
    whole = folds * 2.0 * side * amplitude**2 / (3.0 * stiffness)
    lean = 4.0 * amplitude / pitch
    merged = 0.5 * thickness * math.hypot(1.0, lean)
    assert whole * (1.0 - merged / amplitude) ** 3 < found[Z, Z] < whole


def test_the_mesh_of_an_accordion_fills_its_drawing():
    """The wall is as wide along x at every height; two plates close it."""
    folds, pitch, amplitude, width, thickness, plate = 2, 0.008, 0.005, 0.006, 0.001, 0.003
    module = MODULES["accordion"]()
    design = {"folds": folds, "pitch": pitch, "amplitude": amplitude, "width": width, "thickness": thickness}
    wall = thickness * math.hypot(1.0, 4.0 * amplitude / pitch) * folds * pitch
    plates = 2.0 * plate * 2.0 * (amplitude + 2.0 * thickness)
    assert module.mass(design) == pytest.approx(DENSITY * width * (wall + plates), rel=1e-9)


def test_modules_are_written_for_printing(tmp_path):
    module = MODULES["leaf_spring"]()
    for ending in ("step", "stl"):
        drawing = module.drawing(module.design_space.complete())
        assert write_drawing(drawing, tmp_path / f"leaf.{ending}").stat().st_size > 1000


def test_the_exact_shape_is_written(tmp_path):
    leaf = MODULES["leaf_spring"]()
    assert leaf.write(tmp_path / "leaf.step").read_text().startswith("ISO-10303-21")
    with pytest.raises(ValueError, match=r"must end with \.step or \.stl"):
        leaf.write(tmp_path / "leaf.obj")
