"""Robots in dynamics: slow motions compared with statics, and the Tetrapod under loads and random actions."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.solvers.dynamics import Dynamics, Motion
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.registry import make_robot
from tests.verification.rows import Row


def tetrapod_at_rest(design: dict[str, float] | None = None, **options) -> Dynamics:
    """Return the Tetrapod at rest, with servos held at zero."""
    model = make_robot("tetrapod").build(design)
    rest = Statics(model, tolerance=1e-13).solve(np.zeros(4))
    solver = Dynamics(model, tolerance=1e-12, **options)
    solver.restore(rest.x, rest.effort)
    return solver


ROBOTS: dict[str, tuple[dict[str, object], list[float]]] = {
    "finger": ({}, [0.010, 0.003]),
    "diamond": ({"mesh_size": 30e-3}, [0.010, 0.0, 0.004, 0.0]),
    "tetrapod": ({}, [0.5, -0.3, 0.2, 0.4]),
}
"""Robots of the quasi-static case: options, and a command."""


def quasi_static(names: Sequence[str] = tuple(ROBOTS), rest: int = 60) -> list[Row]:
    """Distance [m] of the effector from its static equilibrium after a slow command and ``rest`` further control steps.

    Rayleigh damping: 5 / s of the masses, 0.01 s of the stiffness; one time step in each control step.
    """
    rows = []
    for name in names:
        options, command = ROBOTS[name]
        robot = make_robot(name, **options)
        still = FEMBackend(robot).step(np.array(command)).effector[0]
        moving = FEMBackend(robot, dynamics=True, time_step=0.05, mass_damping=5.0)
        for k in range(20):
            moving.step((k + 1) / 20.0 * np.array(command))
        state = moving.state
        error = float(np.linalg.norm(state.effector[0] - still))
        rows.append(Row(f"{name}: distance to statics", "after the command", error, 0.0, error))
        for _ in range(rest):
            state = moving.step(np.array(command))
        error = float(np.linalg.norm(state.effector[0] - still))
        rows.append(Row(f"{name}: distance to statics", f"{rest} steps later", error, 0.0, error))
    return rows


def workspace(values: Sequence[float] = (-1.0, 0.0, 1.0), mesh: str = "accurate") -> list[Row]:
    """Static positions of the Tetrapod's centre [mm] with each servo at one of these values times 90 degrees.

    Published: -63 to 63 sideways, -181 to -85 in height, -150 at rest. Equilibria are followed from rest. On the
    published mesh elements fold on the way to some commands.
    """
    statics = Statics(make_robot("tetrapod", mesh=mesh).build())
    rest = statics.solve(np.zeros(4))
    found = {}
    missing = 0
    for signs in product(values, repeat=4):
        statics.restore(rest.x, rest.effort)
        try:
            for k in range(6):
                end = statics.solve((k + 1) / 6.0 * 0.5 * np.pi * np.array(signs))
            found[signs] = 1e3 * end.delta[4:7]
        except ConvergenceError:
            missing += 1
    rows = [Row("Tetrapod: height at rest [mm]", "", 1e3 * float(rest.delta[6]), -150.0)]
    extremes = {
        "lowest [mm]": (min, 2, found, -181.0),
        "highest [mm]": (max, 2, found, -85.0),
        "furthest to the right [mm]": (max, 0, found, 63.0),
        "furthest to the right, two opposite servos [mm]": (
            max,
            0,
            {s: p for s, p in found.items() if s[1] == s[3] == 0.0 and s[0] == -s[2]},
            63.0,
        ),
        "furthest to the right, two neighbouring pairs [mm]": (
            max,
            0,
            {s: p for s, p in found.items() if s[0] == s[1] == -s[2] == -s[3]},
            63.0,
        ),
    }
    for name, (choose, axis, places, published) in extremes.items():
        if places:
            signs = choose(places, key=lambda s: places[s][axis])  # noqa: B023
            rows.append(Row(f"Tetrapod: {name}", f"servos {signs}", float(places[signs][axis]), published))
    rows = [replace(row, error=row.value / row.reference - 1.0) for row in rows]
    rows.append(Row("Tetrapod: commands without equilibrium", f"of {len(found) + missing}", missing))
    return rows


def tetrapod() -> dict[str, object]:
    """Static workspace of the Tetrapod within a quarter turn of its servos, on the accurate mesh [mm]."""
    return {row.case.removeprefix("Tetrapod: "): row.value for row in workspace()}


def fall(solver: Dynamics, seconds: float = 4.0) -> Motion:
    """Step a body until it hardly moves, but no longer than this many seconds."""
    servos = len(solver.model.constraints["a"])
    for _ in range(round(seconds / solver.step)):
        motion = solver.advance(np.zeros(servos))
        if np.abs(motion.velocity).max() < 1e-6:
            break
    return motion


def hanging() -> list[Row]:
    """The Tetrapod under loads [mm]: sag by a mass at its centre, and falls from above against statics."""
    rows = []
    heights = {}
    for payload in (0.0, 0.034, 1.0):
        backend = FEMBackend(make_robot("tetrapod", payload=payload))
        heights[payload] = 1e3 * float(backend.state.effector[0, 2])
        if payload:
            sag = heights[0.0] - heights[payload]
            rows.append(Row("Tetrapod: sag [mm]", f"{1e3 * payload:g} g at its centre", sag))
            torque = float(np.abs(backend.state.effort).max())
            rows.append(Row("Tetrapod: servo torque at rest [N m]", f"{1e3 * payload:g} g at its centre", torque))
    solver = tetrapod_at_rest(step=0.01, stiffness_damping=0.02)
    still = float(solver.model.constraints["e"][0].value(solver.x)[2])
    lifted = Statics(solver.model)
    lifted.restore(solver.x, solver.effort)
    force = np.array([0.0, 0.0, 3.0])
    up = lifted.solve(np.zeros(4), effector_force=force)
    solver.restore(up.x, np.where(np.arange(len(up.effort)) < 4, up.effort, 0.0))
    motion = fall(solver)
    end = float(motion.equilibrium.delta[6])
    setting = f"from {1e3 * (up.delta[6] - still):.0f} mm above, {motion.time:.1f} s"
    rows.append(Row("Tetrapod: fall to rest [mm]", setting, 1e3 * end, 1e3 * still, 1e3 * (end - still)))
    return rows


def random_designs(count: int = 200, seed: int = 0) -> list[Row]:
    """Random bodies of the Tetrapod over the whole box: how many reach rest, and their heights [mm]."""
    robot = make_robot("tetrapod")
    rng = np.random.default_rng(seed)
    heights, failures, unstable = [], 0, 0
    for _ in range(count):
        try:
            state = FEMBackend(robot, robot.design_space.sample(rng)).state
            heights.append(1e3 * float(state.effector[0, 2]))
            unstable += not state.stable
        except ConvergenceError:
            failures += 1
    return [
        Row("Tetrapod: random bodies without rest", f"of {count}", failures),
        Row("Tetrapod: random bodies not stable with free servos", f"of {count}", unstable),
        Row("Tetrapod: lowest rest of random bodies [mm]", f"of {count}", min(heights)),
        Row("Tetrapod: highest rest of random bodies [mm]", f"of {count}", max(heights)),
    ]


TETRAPOD_ENVIRONMENTS = ("SoftGym/TetrapodReach-v0", "SoftGym/TetrapodTrack-v0", "SoftGym/TetrapodCarry-v0")


def robustness(
    actions: int = 10_000, designs: int = 20, identifiers: Sequence[str] = TETRAPOD_ENVIRONMENTS, hold: int = 1
) -> list[Row]:
    """Random actions at the largest rates, over random bodies: every observation finite, every step bounded in time.

    Args:
        actions: number of control steps per environment.
        designs: number of bodies.
        identifiers: the environments.
        hold: control steps that each action lasts; more of them reach the ends of the servos.
    """
    import gymnasium

    import softgym_envs  # noqa: F401  (registers the environments)

    rows = []
    for identifier in identifiers:
        env = gymnasium.make(identifier, sample_design=True)
        rng = np.random.default_rng(0)
        stopped, done, longest, bad = 0, 0, 0.0, 0
        for design in range(designs):
            env.reset(seed=design)
            body = env.unwrapped.design
            share = actions // designs
            for k in range(share):
                if k % hold == 0:
                    action = rng.choice([-1.0, 1.0], 4).astype(np.float32)
                start = time.perf_counter()
                observation, reward, _, truncated, info = env.step(action)
                longest = max(longest, time.perf_counter() - start)
                done += 1
                bad += not (np.isfinite(observation).all() and np.isfinite(reward))
                stopped += not info["converged"]
                if truncated:
                    env.reset(options={"design": body})
        setting = f"{done} actions held for {hold}, {designs} bodies"
        rows.append(Row(f"{identifier}: steps without solution", setting, stopped))
        rows.append(Row(f"{identifier}: values that are not finite", setting, bad))
        rows.append(Row(f"{identifier}: longest step [s]", setting, longest))
    return rows
