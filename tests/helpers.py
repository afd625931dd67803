"""For tests, of the suite and of packages beside it: small meshes, bodies and surrogates, derivatives, processes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csc_matrix
from scipy.spatial.transform import Rotation

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.contact.contact import ContactState
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Actuator, Robot

if TYPE_CHECKING:
    from softgym_envs.extensions.fitting.torch_potential import PotentialNet
    from softgym_envs.surrogate.potential.model import Model

# -- meshes and bodies --------------------------------------------------------------------------------------------


def box_mesh(
    size: Sequence[float] = (1.0, 1.0, 1.0), cells: Sequence[int] = (2, 2, 2), jitter: float = 0.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes [m] (n, 3) and tetrahedra (m, 4) of the box from the origin to ``size``.

    Args:
        size: edge lengths [m], shape (3,).
        cells: number of cuboids along each edge; each cuboid is cut into six tetrahedra.
        jitter: largest random shift of the inner nodes, as a fraction of a cuboid.
        seed: of the random shifts.
    """
    counts = np.array(cells)
    grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.all((grid > 0) & (grid < counts), axis=1)
    noise = np.random.default_rng(seed).uniform(-jitter, jitter, grid.shape) * inside[:, None]
    strides = np.array([(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1])
    corners = grid[np.all(grid < counts, axis=1)] @ strides
    paths = []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        steps = np.concatenate([[0], np.cumsum(strides[list(order)])])
        paths.append(corners[:, None] + steps)
    return (grid + noise) * (np.asarray(size, dtype=float) / counts), np.concatenate(paths)


def clamped_solid(
    element: str = "linear", material: str = "corotational", cells: Sequence[int] = (2, 2, 2), **options: object
) -> MechanicalModel:
    """Return a 20 x 20 x 30 mm block of solid elements on an irregular mesh, clamped at its lower face.

    Args:
        element: name of the solid element.
        material: name of the material.
        cells: cuboids along each edge.
        **options: of `ModelBuilder.add_solid`.
    """
    nodes, tetrahedra = box_mesh((0.02, 0.02, 0.03), cells, jitter=0.2)
    builder = ModelBuilder()
    options = {"young_modulus": 2e5, "poisson_ratio": 0.45, "density": 1000.0, **options}
    fixed = nodes[:, 2] < 1e-9
    builder.add_solid(nodes, tetrahedra, fixed=fixed, element=element, material=material, **options)
    return builder.build()


ASYMMETRIC_SECTION = Section(6e-4, (2e-8, 5e-8), 3e-8, (0.8, 0.7))
"""A beam section without symmetry, so that no two of its stiffnesses can be confused."""


def clamped_beam(order: int = 1, shape: str = "straight", elements: int = 3, **options: object) -> MechanicalModel:
    """Return a beam clamped at one end.

    Args:
        order: order of the beam elements, 1 or 2.
        shape: ``"straight"`` or ``"curved"``, which follows a helix with twisted sections.
        elements: number of elements; their modulus grows along the beam.
        **options: of `Beam`.
    """
    builder = ModelBuilder()
    frames = []
    for k, t in enumerate(np.linspace(0.0, 1.0, order * elements + 1)):
        if shape == "straight":
            position, rotation = np.array([0.2 * t, 0.0, 0.0]), np.eye(3)
        else:
            position = 0.1 * np.array([np.sin(t), 1.0 - np.cos(t), 0.4 * t])
            tangent = np.array([np.cos(t), np.sin(t), 0.4]) / np.sqrt(1.16)
            normal = Rotation.from_rotvec(0.5 * t * tangent).apply([-np.sin(t), np.cos(t), 0.0])
            rotation = np.column_stack([tangent, normal, np.cross(tangent, normal)])
        frames.append(builder.add_frame(position, rotation, fixed=k == 0, fixed_spin=k == 0))
    young = 1e6 * (1.0 + np.arange(elements))
    builder.add_element(
        Beam,
        frames,
        section=ASYMMETRIC_SECTION,
        young_modulus=young,
        poisson_ratio=0.4,
        order=order,
        **options,
    )
    return builder.build()


class Spike(Robot):
    """One tetrahedron that a cable bends."""

    name = "spike"
    effectors = ("tip",)
    size = 0.05
    effector_rest = np.array([0.0, 0.0, 0.05])
    effort_scale = np.array([1.0])
    design_space = DesignSpace(DesignVariable("length", 0.03, 0.07, 0.05, "m", "height of the spike"))
    actuators = (Actuator("cable", 0.0, 0.005, 0.001),)

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        nodes = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, design["length"]]])
        fixed = np.array([True, True, True, False])
        model = MechanicalModel.from_mesh(nodes, np.array([[0, 1, 2, 3]]), fixed=fixed, young_modulus=1e5)
        model.add_cable("cable", nodes[3:], pull_point=np.array([0.02, 0.0, 0.0]))
        model.add_effector("tip", nodes[3])
        return model


# -- derivatives --------------------------------------------------------------------------------------------------


def dense_tangent(model: MechanicalModel, values: np.ndarray) -> np.ndarray:
    """Return the symmetric matrix (n, n) of lower-triangle ``values`` on the model's sparsity pattern."""
    indptr, indices = model.assembly.indptr, model.assembly.indices
    lower = csc_matrix((values.copy(), indices, indptr), shape=2 * (len(indptr) - 1,)).toarray()
    assert np.allclose(np.triu(lower, 1), 0.0)
    return lower + np.tril(lower, -1).T


def contact_slope(model: MechanicalModel, state: ContactState, x: np.ndarray) -> np.ndarray:
    """Return the derivative of the contact energy by the equations (N,) at rows ``x`` (n, 3) of a model with frames."""
    gradient = state.evaluate(x).gradient
    kinematics = model.kinematics
    assert kinematics.map is not None
    kinematics.map.linearise(x)
    slope = np.zeros(kinematics.equations)
    slope[: len(kinematics.free_dofs)] = gradient.ravel()[kinematics.free_dofs]
    return slope + kinematics.map.transposed @ gradient[kinematics.frames.carried].ravel()


def contact_errors(model: MechanicalModel, state: ContactState, x: np.ndarray, h: float) -> tuple[float, float]:
    """Relative errors of gradient and tangent of the contact of a model with frames against central differences.

    Args:
        model: the model.
        state: its contact. For the energy, limits of friction are held.
        x: rows [m], shape (n, 3).
        h: step of the differences [m].
    """
    kinematics, assembly = model.kinematics, model.assembly
    assert kinematics.map is not None
    ways = [[kinematics.displacement(x, s * h * e) for s in (1, -1)] for e in np.eye(kinematics.equations)]
    slope = contact_slope(model, state, x)
    terms = state.evaluate(x)
    state.hold(terms)
    differences = np.array([state.energy(x + plus) - state.energy(x + minus) for plus, minus in ways]) / (2 * h)
    gradient_error = np.abs(differences - slope).max() / np.abs(slope).max()

    tangent = (terms.tangent + terms.directions @ terms.loading.T).toarray()
    # The curvature of frames, which the assembly adds.
    values = np.zeros(len(assembly.keys))
    arms = kinematics.map.linearise(x)
    kinematics.map.add_curvature(values, arms, terms.gradient[kinematics.frames.carried], assembly.spin_target)
    tangent += dense_tangent(model, values[: len(assembly.indices)])
    differences = np.array(
        [contact_slope(model, state, x + plus) - contact_slope(model, state, x + minus) for plus, minus in ways]
    )
    return float(gradient_error), float(np.abs(differences.T / (2 * h) - tangent).max() / np.abs(tangent).max())


@dataclass(frozen=True)
class DerivativeErrors:
    """Relative errors of a model's derivatives against central differences.

    Attributes:
        gradient: of the residual, the derivative of the potential.
        tangent: of the tangent, the derivative of the residual.
        constraints: of the second derivatives of the constraints.
    """

    gradient: float
    tangent: float
    constraints: float


def derivative_errors(model: MechanicalModel, x: np.ndarray, effort: np.ndarray) -> DerivativeErrors:
    """Compare residual and tangent at positions ``x`` [m] (n, 3) with central differences along warped steps.

    The tangent is compared with the symmetric part of the differences: rotations of frames do not commute, and the
    tangent is the second derivative along exponential maps. The contribution of bonds is subtracted.
    """

    def evaluate(y: np.ndarray) -> list[np.ndarray]:
        assembled = model.assembly.evaluate(y, effort, model.loads)
        assert assembled is not None and assembled.tangent is not None, "an element is inverted"
        return [array.copy() for array in (assembled.residual, assembled.tangent, assembled.gradients, assembled.delta)]

    residual, values, H, _ = evaluate(x)
    tangent = dense_tangent(model, values)
    bonds = sum(c.size for c in model.constraints["b"])
    if bonds:
        tangent -= model.assembly.bond_stiffness * H[:, -bonds:] @ H[:, -bonds:].T

    def potential(y: np.ndarray) -> float:
        return model.energy(y) - sum(effort[rows] @ c.value(y) for c, rows in model.rows)

    count, scale = model.equations, model.kinematics.dof_scale
    slope, matrix, gradients = np.empty(count), np.empty((count, count)), np.empty_like(H)
    for k in range(count):
        step = np.zeros(count)
        # Round-off of the energy requires larger steps [m] than round-off of the residual.
        for h, quantity in ((1e-6, "energy"), (1e-7, "residual")):
            step[k] = h / scale[k]
            plus, minus = x + model.warping.displacement(x, step), x + model.warping.displacement(x, -step)
            if quantity == "energy":
                slope[k] = (potential(plus) - potential(minus)) / (2 * step[k])
            else:
                after, before = evaluate(plus), evaluate(minus)
                matrix[:, k] = (after[0] - before[0]) / (2 * step[k])
                gradients[k] = (after[3] - before[3]) / (2 * step[k])
    symmetric = 0.5 * (matrix + matrix.T)
    # Rotations and displacements differ in unit and magnitude: scale each entry by its row and column.
    unit = 1.0 / np.sqrt(np.abs(np.diag(symmetric)))
    scaled = unit[:, None] * np.abs(symmetric - tangent) * unit
    return DerivativeErrors(
        gradient=float((np.abs(slope - residual) / scale).max() / np.abs(residual / scale).max()),
        tangent=float(scaled.max()),
        constraints=float(np.abs(gradients - H).max(initial=0.0) / np.abs(H).max(initial=1.0)),
    )


# -- condensed models and surrogates ------------------------------------------------------------------------------


def random_condensed_model(
    rng: np.random.Generator, actuators: int = 2, effectors: int = 3, contacts: int = 0, spread: float = 0.03
) -> CondensedModel:
    """Return a condensed model with a random positive definite W of a finger's order of magnitude.

    Args:
        rng: random generator.
        actuators: rows of actuators, with efforts between 1 and 5 N.
        effectors: rows of effectors.
        contacts: rows of contacts.
        spread: standard deviation of the free displacement [m].
    """
    n = actuators + effectors + contacts
    half = rng.standard_normal((n, 2 * n))
    W = 1e-3 * (half @ half.T / n + 0.2 * np.eye(n))
    effort = np.concatenate(
        [rng.uniform(1.0, 5.0, actuators), np.zeros(effectors), 0.3 * rng.standard_normal(contacts)]
    )
    roles = (("a", actuators), ("e", effectors), ("c", contacts))
    return CondensedModel(W, spread * rng.standard_normal(n), effort, tuple(role for role in roles if role[1]))


def random_states(robot: Robot, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` random designs, shape (count, n_design), and actuator displacements, shape (count, n_a)."""
    rng = np.random.default_rng(seed)
    designs = np.array([robot.design_space.sample(rng).array for _ in range(count)])
    return designs, rng.uniform(robot.lower, robot.upper, (count, len(robot.actuators)))


def untrained_potential(
    robot: Robot, members: int = 2, width: int = 16, rest: bool = True, seed: int = 0
) -> tuple[Model, list[PotentialNet]]:
    """Return a potential with random weights, and its ensemble members as torch modules.

    Args:
        robot: robot that the potential describes.
        members: size of the ensemble.
        width: of the hidden layers.
        rest: whether the effort is zero at zero displacement by construction.
        seed: of the weights.
    """
    import torch

    from softgym_envs.extensions.fitting.potential import stack_members
    from softgym_envs.extensions.fitting.torch_potential import PotentialNet
    from softgym_envs.surrogate.features import Features
    from softgym_envs.surrogate.potential.model import Model

    torch.manual_seed(seed)
    n, e = len(robot.actuators), 3 * len(robot.effectors)
    design = Features(robot).design_size
    middle, half = 0.5 * (robot.upper + robot.lower), 0.5 * (robot.upper - robot.lower)
    at_rest = -middle / half if rest else None
    nets = [PotentialNet(n, e, design, width, 16, at_rest, robot.learning.convex) for _ in range(members)]
    scales = {
        "energy": np.array(2.0),
        "effector_mean": np.linspace(-0.1, 0.1, e),
        "effector": np.array(0.03),
        "held": np.array(1e-3),
    }
    states = [{k: v.detach().numpy() for k, v in net.state_dict().items()} for net in nets]
    return Model(robot, stack_members(states, scales), {}), nets


def sample_states(
    robot: Robot, states: int, seed: int, *, limit: float, sequence: str = "random"
) -> dict[str, np.ndarray]:
    """Return FEM equilibria of the baseline body as columns of a dataset.

    Args:
        robot: robot to sample.
        states: number of equilibria.
        seed: of the commands.
        limit: largest actuator displacement [m].
        sequence: name of a sampling sequence.
    """
    from softgym_envs.extensions.fitting.data.sampling import SamplingPlan, sample_group

    full = robot.actuators
    robot.actuators = tuple(replace(actuator, high=limit) for actuator in full)
    try:
        data, _ = sample_group(robot, SamplingPlan(1, states, sequence, seed, vary=()), 0)
    finally:
        robot.actuators = full
    assert data is not None
    return data


def train_small_surrogate(
    folder: Path,
    robot: Robot,
    *,
    limit: float,
    states: int = 300,
    members: int = 5,
    width: int = 48,
    steps: int = 1500,
) -> None:
    """Train a surrogate of the baseline body on displacements up to ``limit`` [m] and write it to ``folder``."""
    from softgym_envs.extensions.fitting import potential
    from softgym_envs.extensions.fitting.data.states import training_states
    from softgym_envs.extensions.fitting.trainer import Trainer
    from softgym_envs.extensions.fitting.training import domain_of
    from softgym_envs.surrogate.features import Features
    from softgym_envs.surrogate.weight_files import new_card, save_model

    training = sample_states(robot, states, 0, limit=limit, sequence="halton")
    validation = sample_states(robot, max(states // 3, 20), 1, limit=limit)
    card = new_card(robot, "potential")
    features = Features(robot)
    options = potential.Options(width=width, body_width=width // 2, members=members, steps=steps, batch_size=128)
    tensors, _ = potential.train(
        robot,
        training_states(robot, training, features),
        training_states(robot, validation, features),
        Trainer(options, seed=0),
    )
    model = potential.Model(robot, tensors, card)
    save_model(potential.Model(robot, tensors, {**card, "domain": domain_of(model, training, validation)}), folder)


# -- processes ----------------------------------------------------------------------------------------------------


def live_processes(session: int) -> list[int]:
    """Return the IDs of the processes of a session that are still running; zombies do not count. Linux only."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state = (folder / "stat").read_text().rsplit(")", 1)[1].split()[0]
            if state not in "ZX" and os.getsid(int(folder.name)) == session:
                found.append(int(folder.name))
        except (FileNotFoundError, ProcessLookupError):
            continue
    return found


def wait_until(
    condition: Callable[[], object], *, interval: float = 0.01, failed: Callable[[], str | None] = lambda: None
) -> None:
    """Wait until ``condition()`` holds, without a deadline, so that a slow machine causes no failure.

    Args:
        condition: what to wait for.
        interval: time between two checks [s].
        failed: returns a message once the condition can no longer become true, else None.

    Raises:
        RuntimeError: with the message of ``failed``.
    """
    while not condition():
        message = failed()
        if message is not None and not condition():
            raise RuntimeError(message)
        time.sleep(interval)
