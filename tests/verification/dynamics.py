"""Dynamics compared with exact solutions, conservation laws and statics.

``python -m tests.verification dynamics`` computes all cases at full length. Every case is a function that returns
rows; the tests run shorter versions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import eigh
from scipy.optimize import brentq
from scipy.sparse import csc_matrix
from scipy.spatial.transform import Rotation

from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.bond import Bond
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.rigid import box_inertia
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.dynamics import SCHEMES, Dynamics
from softgym_envs.mechanics.solvers.statics import Statics
from tests.helpers import box_mesh
from tests.verification.robot_dynamics import (
    hanging,
    quasi_static,
    random_designs,
    robustness,
    tetrapod_at_rest,
    workspace,
)
from tests.verification.rows import Row, as_results, with_orders

GRAVITY = (0.0, 0.0, -9.81)


# -- bodies ---------------------------------------------------------------------------------------------------------


def solid_bar(
    *, clamped: bool, cells: Sequence[int] = (8, 2, 2), element: str = "linear", young_modulus: float = 1e6, **options
) -> MechanicalModel:
    """Return a bar of 0.2 x 0.02 x 0.02 m along x, clamped at x = 0 or free."""
    nodes, tetrahedra = box_mesh(cells=cells)
    fixed = (nodes[:, 0] == 0.0) & clamped
    body = ModelBuilder(floating=not clamped, **options)
    material = {"young_modulus": young_modulus, "poisson_ratio": 0.3, "density": 1000.0}
    body.add_solid(nodes * [0.2, 0.02, 0.02], tetrahedra, fixed=fixed, element=element, **material)
    model = body.build()
    if clamped:
        model.add_effector("tip", np.array([0.2, 0.01, 0.01]))
    return model


def rod(*, clamped: bool, elements: int = 8, order: int = 2, radius: float = 0.01, **options) -> MechanicalModel:
    """Return a round beam of 1 m along x, clamped at x = 0 or free."""
    body = ModelBuilder(floating=not clamped, **options)
    frames = [
        body.add_frame([s, 0.0, 0.0], fixed=clamped and s == 0.0, fixed_spin=clamped and s == 0.0)
        for s in np.linspace(0.0, 1.0, order * elements + 1)
    ]
    material = {"young_modulus": 1e7, "poisson_ratio": 0.3, "density": 1000.0}
    body.add_element(Beam, frames, section=Section.circle(radius), order=order, **material)
    model = body.build()
    model.add("e", Point("tip", EmbeddedPoints.in_frame(frames[-1], np.zeros(3), model.nodes)))
    return model


def rigid_box(**options) -> MechanicalModel:
    """Return a free box of 1 kg with half-extents 0.1, 0.2 and 0.4 m."""
    body = ModelBuilder(floating=True, **options)
    frame = body.add_frame([0.0, 0.0, 0.0])
    body.add_mass(frame, 1.0, box_inertia(1.0, np.array([0.1, 0.2, 0.4])))
    return body.build()


def waves(model: MechanicalModel, spin: float) -> np.ndarray:
    """Velocities of the equations (N,) of a bar or rod along x: two waves of bending, and a spin [rad/s] about z."""
    free = model.kinematics.free_dofs // 3, model.kinematics.free_dofs % 3
    points = np.flatnonzero(np.bincount(free[0], minlength=len(model.nodes)))
    length = np.ptp(model.nodes[points, 0])
    s = model.nodes[:, 0] / length - 0.5
    across = np.column_stack(
        [0 * s, length * (spin * s + 0.2 * np.cos(2 * np.pi * s)), 0.1 * length * np.cos(np.pi * s)]
    )
    slope_y, slope_z = spin - 0.4 * np.pi * np.sin(2 * np.pi * s), -0.1 * np.pi * np.sin(np.pi * s)
    velocity = np.zeros(model.equations)
    velocity[: len(model.kinematics.free_dofs)] = across[free]
    rows = model.frames.rows
    velocity[len(model.kinematics.free_dofs) :] = np.column_stack([0 * rows, -slope_z[rows], slope_y[rows]]).ravel()
    return velocity


def momenta(solver: Dynamics) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular momentum of the present state [kg m/s, kg m2/s], each (3,)."""
    flow = solver.model.assembly.mass_matrix().rows @ solver.velocity
    directors = (solver.model.frames.rows[:, None] + np.arange(1, 4)).ravel()
    linear = np.delete(flow, directors, axis=0).sum(axis=0)
    return linear, np.cross(solver.x, flow).sum(axis=0)


# -- conservation ---------------------------------------------------------------------------------------------------


def conservation(steps: int = 1000) -> list[Row]:
    """Largest relative drift over a spinning, bending free body's motion; spectral radius 1."""
    rows = []
    bodies = {
        "free solid": (solid_bar(clamped=False), 0.002, 2.0),
        "free beam": (rod(clamped=False), 0.004, 2.0),
    }
    for name, (model, step, spin) in bodies.items():
        solver = Dynamics(model, step=step, scheme="generalised_alpha", spectral_radius=1.0)
        # Drift sideways, so that the linear momentum is not zero.
        velocity = waves(model, spin)
        velocity[: len(model.kinematics.free_dofs)] += 0.1 * (model.kinematics.free_dofs % 3 == 0)
        solver.launch(velocity)
        energy, (linear, angular) = sum(solver.energies()), momenta(solver)
        worst = np.zeros(3)
        for _ in range(steps):
            motion = solver.advance([])
            now = momenta(solver)
            worst = np.maximum(
                worst,
                [
                    abs(motion.energy / energy - 1.0),
                    np.linalg.norm(now[0] - linear) / np.linalg.norm(linear),
                    np.linalg.norm(now[1] - angular) / np.linalg.norm(angular),
                ],
            )
        for quantity, drift in zip(("energy", "linear momentum", "angular momentum"), worst, strict=True):
            setting = f"{steps} steps of {step:g} s"
            rows.append(Row(f"{name}: drift of {quantity}", setting, float(drift), 0.0, float(drift)))
    return rows


# -- order of convergence -------------------------------------------------------------------------------------------


def swinging(model: MechanicalModel, speed: float, **options) -> Dynamics:
    """Return a clamped body that starts with the velocities of its first mode, scaled to a tip speed [m/s].

    The initial motion contains nothing that a time step cannot resolve.
    """
    _, modes = eigenmodes(model, lumped=False, count=1)
    solver = Dynamics(model, tolerance=1e-12, **options)
    solver.launch(modes[:, 0])
    solver.launch(modes[:, 0] * speed / np.linalg.norm(solver.effector_velocity()))
    return solver


def tumbling(duration: float, spin: np.ndarray, inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrix and spin [rad/s] after a free body's motion, by Euler's equations and quaternions."""
    moments = np.diag(inertia)

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        w, q = y[:3], y[3:]
        turn = 0.5 * np.concatenate([[-w @ q[1:]], q[0] * w + np.cross(q[1:], w)])
        return np.concatenate([-np.cross(w, moments * w) / moments, turn])

    start = np.concatenate([spin, [1.0, 0.0, 0.0, 0.0]])
    end = solve_ivp(slope, (0.0, duration), start, rtol=1e-12, atol=1e-12, method="DOP853").y[:, -1]
    rotation = Rotation.from_quat(np.roll(end[3:], -1)).as_matrix()
    return rotation, rotation @ end[:3]


SPIN = np.array([0.3, 3.0, 0.2])
"""Spin of the box, almost about its middle axis, so that it turns over [rad/s]."""


def order(levels: Sequence[int] = (64, 128, 256), fine: int = 2048) -> list[Row]:
    """Tips of cantilevers in a large swing against a fine step; the rotation of a free box against Euler's equations.

    Settings are steps per run. Errors are relative to the path of the tip, or those of the rotation matrix.
    """
    rows = []
    bodies = {
        "solid cantilever": (solid_bar(clamped=True, cells=(6, 1, 1), young_modulus=5e5), 1.0, 0.2),
        "beam cantilever": (rod(clamped=True, elements=4), 1.0, 2.0),
    }
    for name, (model, speed, duration) in bodies.items():

        def tip(scheme: str, steps: int, model=model, speed=speed, duration=duration) -> np.ndarray:
            solver = swinging(model, speed, step=duration / steps, scheme=scheme)
            for _ in range(steps):
                end = solver.advance([]).equilibrium.delta
            return end

        reference = tip("generalised_alpha", fine)
        way = float(np.linalg.norm(reference - model.constraints["e"][0].value(model.nodes)))
        for scheme in SCHEMES:
            errors = [float(np.linalg.norm(tip(scheme, steps) - reference)) / way for steps in levels]
            case = f"{name}: tip, {scheme}"
            rows += with_orders([Row(case, f"{n} steps", e * way, 0.0, e) for n, e in zip(levels, errors, strict=True)])
    duration = 2.0
    exact, _ = tumbling(duration, SPIN, box_inertia(1.0, np.array([0.1, 0.2, 0.4])))
    for scheme in SCHEMES:
        found = []
        for steps in levels:
            solver = Dynamics(rigid_box(), step=duration / steps, scheme=scheme, tolerance=1e-12)
            solver.launch(np.concatenate([[0.1, 0.0, 0.0], SPIN]))
            for _ in range(steps):
                solver.advance([])
            error = float(np.linalg.norm(solver.x[1:4].T - exact))
            found.append(Row(f"free box: rotation, {scheme}", f"{steps} steps", error, 0.0, error))
        rows += with_orders(found)
    return rows


# -- frequencies ----------------------------------------------------------------------------------------------------


def eigenmodes(model: MechanicalModel, lumped: bool, count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Lowest angular frequencies [rad/s] (count,) about rest and the modes (N, count), by tangent and mass matrix."""
    assembly = model.assembly
    assembled = assembly.evaluate(model.nodes, np.zeros(assembly.size), model.loads)
    assert assembled is not None
    tangent, indptr, indices = assembled.tangent.copy(), assembly.indptr, assembly.indices
    lower = csc_matrix((tangent, indices, indptr)).toarray()
    stiffness = lower + np.tril(lower, -1).T
    # The mass matrix acts on rows, so find how each equation moves them.
    motions = np.array([model.kinematics.row_velocity(model.nodes, unit) for unit in np.eye(model.equations)])
    matrix = model.assembly.mass_matrix(lumped).rows
    mass = np.einsum("and,bnd->ab", motions, np.array([matrix @ motion for motion in motions]))
    squares, modes = eigh(stiffness, mass, subset_by_index=[0, count - 1])
    return np.sqrt(squares), modes


def euler_bernoulli(length: float, bending: float, mass: float, count: int = 3) -> np.ndarray:
    """Angular frequencies [rad/s] of a cantilever: cosh(b) cos(b) = -1, w = (b / L)^2 sqrt(EI / rho A)."""
    roots = [brentq(lambda b: np.cos(b) + 1.0 / np.cosh(b), np.pi * (k + 0.1), np.pi * (k + 0.9)) for k in range(count)]
    return (np.array(roots) / length) ** 2 * np.sqrt(bending / mass)


def frequencies(elements: int = 16, cells: int = 40) -> list[Row]:
    """First bending frequencies [Hz] of a slender cantilever, r = L / 200, against Euler and Bernoulli's beam.

    The solid bar is quadratic, thicker (L / 20) and without lateral contraction.
    """
    rows = []
    section = Section.circle(0.005)
    exact = euler_bernoulli(1.0, 1e7 * section.inertia[0], 1000.0 * section.area) / (2.0 * np.pi)
    for order_, lumped in ((2, False), (2, True), (1, False), (1, True)):
        model = rod(clamped=True, elements=elements * (3 - order_), order=order_, radius=0.005)
        found, _ = eigenmodes(model, lumped)
        # Every bending mode appears twice, once for each direction.
        values = found[[0, 2, 4]] / (2.0 * np.pi)
        for k, (value, reference) in enumerate(zip(values, exact, strict=True)):
            setting = f"beam of order {order_}, {'lumped' if lumped else 'consistent'}"
            rows.append(Row(f"bending frequency {k + 1}", setting, value, reference, value / reference - 1.0))
    return rows


def history(steps: int = 600) -> list[Row]:
    """First frequency [Hz] from zero crossings of a small free swing in time, against that of tangent and masses."""
    rows = []
    for name, model in (
        ("beam", rod(clamped=True, elements=4, radius=0.005)),
        ("solid", solid_bar(clamped=True, cells=(10, 1, 1), element="quadratic")),
    ):
        frequency = eigenmodes(model, lumped=False, count=1)[0][0] / (2.0 * np.pi)
        step = 3.0 / frequency / steps
        solver = swinging(model, 1e-3 * frequency, step=step, scheme="generalised_alpha", spectral_radius=1.0)
        axis = int(np.argmax(np.abs(solver.effector_velocity())))
        start = model.constraints["e"][0].value(model.nodes)[axis]
        swing = np.array([solver.advance([]).equilibrium.delta[axis] - start for _ in range(steps)])
        last = np.flatnonzero(swing[:-1] * swing[1:] < 0.0)
        crossings = step * (last + 1 + swing[last] / (swing[last] - swing[last + 1]))
        value = 0.5 * (len(crossings) - 1) / (crossings[-1] - crossings[0])
        setting = f"{name}, {steps} steps in three periods"
        rows.append(Row("first frequency in time", setting, value, frequency, value / frequency - 1.0))
    return rows


# -- rigid parts ----------------------------------------------------------------------------------------------------

BAR = np.array([0.02, 0.03, 0.2])
"""Half-extents of the bars of a pendulum [m]; joints are at both ends of the last axis. Each weighs 1 kg."""
HORIZONTAL = np.column_stack([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Rotation of a bar that points along x, away from the joint at its upper end."""


def pendulum(count: int, spin: Sequence[float], *, joint: str = "bond", **options) -> Dynamics:
    """Bars in a chain from a fixed point, first along x, with a common spin [rad/s] (3,) about that point.

    Args:
        count: number of bars.
        spin: about the axes of space.
        joint: how the first bar is held: by a ``"bond"``, or by a ``"frame"`` at the fixed point that carries it.
        **options: of `Dynamics`.
    """
    body = ModelBuilder(gravity=GRAVITY, floating=joint == "bond")
    end = np.array([0.0, 0.0, BAR[2]])
    bars = []
    for k in range(count):
        position = [(2 * k + 1) * BAR[2], 0.0, 0.0]
        if joint == "frame" and k == 0:
            pivot = body.add_frame(np.zeros(3), fixed=True)
            bars.append(body.add_frame(position, HORIZONTAL, on=pivot))
        else:
            bars.append(body.add_frame(position, HORIZONTAL))
        body.add_mass(bars[-1], 1.0, box_inertia(1.0, BAR))
    model = body.build()
    for k, bar in enumerate(bars):
        upper = EmbeddedPoints.in_frame(bar, end, model.nodes)
        if k:
            model.add("b", Bond(f"joint {k}", upper, EmbeddedPoints.in_frame(bars[k - 1], -end, model.nodes)))
        elif joint == "bond":
            model.add("b", Bond("pivot", upper, np.zeros(3)))
    model.add("e", Point("end", EmbeddedPoints.in_frame(bars[-1], -end, model.nodes)))
    solver = Dynamics(model, tolerance=1e-12, **options)
    velocity = np.cross(spin, model.nodes)
    solver.launch(model.kinematics.equation_velocity(model.nodes, velocity))
    return solver


def pendulum_exact(count: int, spin: Sequence[float], duration: float) -> np.ndarray:
    """End of the chain of `pendulum` [m] (3,), by Newton's and Euler's equations with the joints' forces eliminated."""
    moments, end = np.diag(box_inertia(1.0, BAR)), np.array([0.0, 0.0, BAR[2]])

    def skew(r: np.ndarray) -> np.ndarray:
        return np.cross(np.eye(3), r)

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        p, v, w, q = np.split(y, np.cumsum([3 * count] * 3))
        p, v, w, q = (a.reshape(count, -1) for a in (p, v, w, q))
        turns = Rotation.from_quat(q).as_matrix()
        matrix, right = np.zeros((9 * count, 9 * count)), np.zeros(9 * count)
        for k in range(count):
            a, b, c = (slice(j, j + 3) for j in (6 * k, 6 * k + 3, 6 * count + 3 * k))
            inertia = turns[k] @ np.diag(moments) @ turns[k].T
            matrix[a, a], matrix[b, b] = np.eye(3), inertia
            right[a], right[b] = GRAVITY, -np.cross(w[k], inertia @ w[k])
            # The upper end of bar k is joined to the lower end of the bar before.
            for bar, sign in ((k, 1.0), (k - 1, -1.0)):
                if bar < 0:
                    continue
                r = sign * (turns[bar] @ end)
                matrix[c, 6 * bar : 6 * bar + 3] = sign * np.eye(3)
                matrix[c, 6 * bar + 3 : 6 * bar + 6] = -sign * skew(r)
                right[c] -= sign * np.cross(w[bar], np.cross(w[bar], r))
            matrix[:, c] = matrix[c].T
        found = np.linalg.solve(matrix, right)[: 6 * count].reshape(count, 6)
        turning = 0.5 * np.array([[*(s * wk + np.cross(wk, u)), -wk @ u] for wk, u, s in zip(w, q[:, :3], q[:, 3])])  # noqa: B905
        return np.concatenate([v.ravel(), found[:, :3].ravel(), found[:, 3:].ravel(), turning.ravel()])

    places = np.array([[(2 * k + 1) * BAR[2], 0.0, 0.0] for k in range(count)])
    quaternion = Rotation.from_matrix(HORIZONTAL).as_quat()
    start = [places, np.cross(spin, places), np.tile(spin, (count, 1)), np.tile(quaternion, (count, 1))]
    y = solve_ivp(
        slope, (0.0, duration), np.concatenate([a.ravel() for a in start]), rtol=1e-11, atol=1e-12, method="DOP853"
    ).y[:, -1]
    last = Rotation.from_quat(y[-4:]).as_matrix()
    return y[3 * count - 3 : 3 * count] - last @ end


def rigid(levels: Sequence[int] = (50, 100, 200, 400)) -> list[Row]:
    """Rigid parts over one second, in steps: momentum of a tumbling box, and ends of pendulums against exact equations.

    Errors: relative (momentum, energy) and distances [m]. The box spins almost about its middle axis and turns over.
    """
    rows = []
    duration = 2.0
    for quantity in ("angular momentum", "energy"):
        found = []
        for steps in levels:
            solver = Dynamics(
                rigid_box(), step=duration / steps, scheme="generalised_alpha", spectral_radius=1.0, tolerance=1e-13
            )
            solver.launch(np.concatenate([[0.1, 0.0, 0.0], SPIN]))
            before = momenta(solver)[1], solver.energies()[0]
            drift = 0.0
            for _ in range(steps):
                solver.advance([])
                after = momenta(solver)[1], solver.energies()[0]
                change = np.linalg.norm(after[0] - before[0]) / np.linalg.norm(before[0])
                drift = max(drift, float(change) if quantity == "angular momentum" else abs(after[1] / before[1] - 1.0))
            found.append(Row(f"tumbling box: drift of {quantity}", f"{steps} steps", drift, 0.0, drift))
        rows += with_orders(found)
    chains = {
        "heavy top on a bond": (1, [8.0, 0.0, 2.0], {"joint": "bond"}),
        "heavy top on a frame": (1, [8.0, 0.0, 2.0], {"joint": "frame"}),
        "double pendulum": (2, [3.0, 0.5, 1.0], {}),
    }
    for name, (count, spin, options) in chains.items():
        exact = pendulum_exact(count, spin, 1.0)
        for scheme in SCHEMES:
            found = []
            for steps in levels:
                solver = pendulum(count, spin, step=1.0 / steps, scheme=scheme, **options)
                for _ in range(steps):
                    end = solver.advance([]).equilibrium.delta[:3]
                error = float(np.linalg.norm(end - exact))
                found.append(Row(f"{name}: end, {scheme}", f"{steps} steps", error, 0.0, error))
            rows += with_orders(found)
    return rows


# -- actuators ------------------------------------------------------------------------------------------------------


def pulled_bar(**options) -> MechanicalModel:
    """Return a hanging bar of 0.2 m with a cable off its axis and an effector at its tip."""
    nodes, tetrahedra = box_mesh(cells=(2, 2, 8))
    body = ModelBuilder(gravity=GRAVITY)
    nodes = nodes * [0.02, 0.02, 0.2]
    options = {"element": "linear", "young_modulus": 5e5, "poisson_ratio": 0.4, "density": 1000.0, **options}
    body.add_solid(nodes, tetrahedra, fixed=nodes[:, 2] > 0.199, **options)
    model = body.build()
    cable = np.array([[0.016, 0.009, z] for z in (0.18, 0.1, 0.02)])
    model.add_cable("cable", cable, np.array([0.016, 0.009, 0.205]))
    model.add_effector("tip", np.array([0.011, 0.01, 0.0]))
    return model


def pulled_bar_at_rest(**options) -> Dynamics:
    """Return the bar at rest under its weight, with the cable held."""
    model = pulled_bar()
    rest = Statics(model, tolerance=1e-13).solve([0.0])
    solver = Dynamics(model, tolerance=1e-13, **options)
    solver.restore(rest.x, rest.effort)
    return solver


DAMPING = {"mass_damping": 0.5, "stiffness_damping": 0.01}


def compliance(scheme: str = "euler") -> list[Row]:
    """W of a step in the middle of a motion against central differences of the efforts; error relative to its size.

    Units are mixed, so every row and column is scaled by its diagonal entry.
    """
    rows = []
    machines: dict[str, tuple[Callable[..., Dynamics], np.ndarray, float]] = {
        "bar with a cable": (pulled_bar_at_rest, np.array([0.01]), 1e-4),
        "Tetrapod": (tetrapod_at_rest, np.array([0.3, -0.2, 0.1, 0.25]), 1e-4),
    }
    for name, (build, pull, size) in machines.items():
        for damping in ({}, DAMPING):
            solver = build(step=0.01, scheme=scheme, **damping)
            n = len(pull)
            for k in range(8):
                # Start smoothly: otherwise the second-order scheme oscillates and divides its steps.
                motion = solver.advance(0.5 * (1.0 - np.cos(0.6 * np.pi * (k + 1) / 8.0)) * pull)
            effort = motion.equilibrium.effort[: n + 3]
            kept = solver.snapshot
            condensed = solver.advance(effort[:n], "effort").equilibrium.condensed
            W, found = condensed.compliance, np.empty((n + 3, n + 3))
            scale = 1.0 / np.sqrt(np.diag(W))
            for i in range(n + 3):
                ends = []
                for sign in (1.0, -1.0):
                    solver.snapshot = kept
                    push = np.zeros(n + 3)
                    push[i] = sign * size * scale[i]
                    ends.append(
                        solver.advance(effort[:n] + push[:n], "effort", effector_force=push[n:]).equilibrium.delta[
                            : n + 3
                        ]
                    )
                found[:, i] = (ends[0] - ends[1]) / (2.0 * size * scale[i])
            error = float(np.abs(scale[:, None] * (found - W) * scale).max())
            setting = f"{scheme}, {'Rayleigh damping' if damping else 'no damping'}"
            rows.append(Row(f"{name}: W of one step", setting, error, 0.0, error))
    return rows


def book_keeping(levels: Sequence[int] = (50, 100, 200)) -> list[Row]:
    """Error of the balance ``work = change of energy + dissipation`` over the work, while actuators move for 0.5 s.

    Implicit Euler loses energy by numerical damping, so its error is positive and falls with the step.
    """
    rows = []
    machines: dict[str, tuple[Callable[..., Dynamics], np.ndarray]] = {
        "bar with a cable": (pulled_bar_at_rest, np.array([0.015])),
        "Tetrapod": (tetrapod_at_rest, np.array([0.6, -0.3, 0.2, 0.5])),
    }
    for name, (build, pull) in machines.items():
        for scheme in SCHEMES:
            for damping in ({}, DAMPING):
                found = []
                for steps in levels:
                    solver = build(step=0.5 / steps, scheme=scheme, **damping)
                    start = sum(solver.energies())
                    for k in range(steps):
                        # Start and end smoothly.
                        motion = solver.advance(0.5 * (1.0 - np.cos(np.pi * (k + 1) / steps)) * pull)
                    missing = (motion.work - (motion.energy - start) - motion.dissipated) / motion.work
                    kind = "Rayleigh damping" if damping else "no damping"
                    case = f"{name}: energy missing, {scheme}, {kind}"
                    found.append(Row(case, f"{steps} steps", missing, 0.0, missing))
                rows += with_orders(found)
    return rows


# -- all cases ------------------------------------------------------------------------------------------------------

CASES: dict[str, Callable[[], list[Row]]] = {
    "conservation": conservation,
    "order": order,
    "frequencies": frequencies,
    "history": history,
    "rigid": rigid,
    "compliance": lambda: [row for scheme in SCHEMES for row in compliance(scheme)],
    "book_keeping": book_keeping,
    "quasi_static": quasi_static,
    "workspace": workspace,
    "hanging": hanging,
    "random_designs": random_designs,
    "robustness": lambda: robustness() + robustness(2000, 20, ("SoftGym/TetrapodReach-v0",), hold=15),
}
"""Registry of cases."""


def dynamics() -> dict[str, object]:
    """Conservation, convergence, frequencies, rigid parts, energy, statics, the Tetrapod, and random actions."""
    rows = [row for case in CASES.values() for row in case()]
    width = max(len(row.case) + len(row.setting) for row in rows) + 3
    print(f"  {'case | setting':{width}s} {'value':>12s} {'reference':>12s} {'error':>10s} {'order':>6s}")
    for row in rows:
        numbers = [f"{row.value:12.6g}"]
        numbers += [
            "" if np.isnan(number) else f"{number:{form}}"
            for number, form in ((row.reference, "12.6g"), (row.error, "10.2g"), (row.order, "6.2f"))
        ]
        label = f"{row.case} | {row.setting}"
        print(f"  {label:{width}s} {numbers[0]} {numbers[1]:>12s} {numbers[2]:>10s} {numbers[3]:>6s}")
    return as_results(rows, "case", "setting")
