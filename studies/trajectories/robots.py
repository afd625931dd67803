"""Published trajectories, followed with finite elements, and the published compliance of the Stiff-Flop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

PUBLISHED_COMPLIANCE = {
    "W_aa base, same pair": 0.3057,
    "W_aa base, two pairs": 0.0640,
    "W_aa tip, same pair": 0.5293,
    "W_aa tip, two pairs": 0.1028,
    "W_xa base": 0.0429,
    "W_xa tip": 0.0734,
    "W_ya base": 1.0065,
    "W_ya tip": 0.7085,
    "W_za base": 1.162,
    "W_za tip": 0.818,
    "W_xx": 0.0393,
    "W_yy": 11.59,
}
"""Rest compliance of the Stiff-Flop in the authors' public data (the thesis has none), in mm3, mm, kPa and mN."""


class _Timer:
    """Seconds spent in calls."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.calls = 0

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*arguments)
        finally:
            self.seconds += time.perf_counter() - start
            self.calls += 1

    @property
    def milliseconds(self) -> float:
        """Per call."""
        return 1e3 * self.seconds / max(self.calls, 1)


def _errors(name: str, errors: np.ndarray) -> dict[str, object]:
    return {f"{name}: largest error [mm]": 1e3 * float(errors.max()), f"{name}: mean [mm]": 1e3 * float(errors.mean())}


def _follow(
    name: str,
    robot_name: str,
    *,
    goals: np.ndarray | int | None = None,
    approach: int,
    calls: int,
    weights: Sequence[float] = (1.0, 1.0, 1.0),
    options: Mapping[str, object] | None = None,
) -> dict[str, object]:
    """Follow goals (default: the reference path) in displacement, with the measured state, ``calls`` for each.

    The errors are those after the last call for each goal, in the coordinates that have a weight.

    Args:
        name: of the case.
        robot_name: registry name.
        goals: [m], shape (p, 3), or their number along the reference path.
        approach: number of goals on the straight line from rest to the first goal; their errors do not count.
        calls: number of controller calls for each goal.
        weights: of the coordinates of the effector.
        options: of the robot.
    """
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.control.inverse_qp import InverseQP
    from softgym_envs.robots.registry import make_robot

    robot = make_robot(robot_name, **dict(options or {}))
    backend = FEMBackend(robot)
    controller = InverseQP.for_robot(robot, goal_weights=np.asarray(weights))
    path = goals if isinstance(goals, np.ndarray) else robot.reference_path(*([] if goals is None else [goals]))
    start = backend.step(np.zeros(len(robot.actuators))).effector[0]
    lead = np.linspace(start, path[0], approach + 1)[1:]
    command, errors, qp, fem = np.zeros(len(robot.actuators)), [], _Timer(), _Timer()
    chosen = np.asarray(weights) > 0.0
    for goal in np.vstack([lead, path]):
        for _ in range(calls):
            state = backend.state
            command = qp(controller.solve, state.condensed, goal, command, state.slack)
            fem(backend.step, command)
        errors.append(np.linalg.norm((backend.state.effector[0] - goal)[chosen]))
    return {
        **_errors(name, np.array(errors[approach:])),
        f"{name}: controller [ms per call]": qp.milliseconds,
        f"{name}: FEM [ms per call]": fem.milliseconds,
    }


def _finger_bending(cables: int) -> np.ndarray:
    """Tip of the finger at 25 equal cable displacements up to 20 mm: a quarter of a turn, all of it in reach."""
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.robots.registry import make_robot

    backend = FEMBackend(make_robot("finger", cables=cables))
    return np.array([backend.step(np.full(cables, pull)).effector[0] for pull in np.linspace(0.0, 0.020, 25)])


def _embedded_trunk(
    name: str, *, stiffness: float = 1.0, encoders: bool = False, gains: tuple[float, float] | None = None, calls: int
) -> dict[str, object]:
    """Circle of radius 40 mm of the Stiff-Flop, commanded in pressure: 200 goals to reach it and 600 along it.

    Args:
        name: of the case.
        stiffness: of the plant over that of the model.
        encoders: measure the volumes of the chambers; otherwise the model predicts them (thesis, algorithm 2).
        gains: proportional and integral gain per call of the closed loop, or None.
        calls: number of controller calls for each goal.
    """
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.control.embedded import EmbeddedLoop, PICorrection
    from softgym_envs.control.inverse_qp import InverseQP
    from softgym_envs.robots.registry import make_robot

    robot = make_robot("trunk")
    count = len(robot.actuators)
    baseline = robot.design_space.baseline
    model = FEMBackend(robot)
    plant = FEMBackend(robot, {key: stiffness * baseline[key] for key in ("base_modulus", "tip_modulus")})
    controller = InverseQP.for_robot(
        robot,
        rates=np.full(count, np.inf),
        max_effort=np.full(count, 200e3),
        effort_rates=np.full(count, 5e3),
        mode="effort",
    )
    loop = EmbeddedLoop(model, controller, None if gains is None else PICorrection(*gains))
    circle = robot.reference_path(600)
    lead = np.linspace(robot.effector_rest, circle[0], 201)[1:]
    errors, control = [], _Timer()
    for goal in np.vstack([lead, circle]):
        for _ in range(calls):
            state = plant.state
            measured = None if gains is None else state.effector.ravel()
            displacement = state.displacement if encoders else None
            plant.step(control(lambda g, m, d: loop.step(g, m, displacement=d), goal, measured, displacement), "effort")
        errors.append(np.linalg.norm(plant.state.effector[0] - goal))
    return {
        **_errors(name, np.array(errors[200:])),
        f"{name}: controller with its FEM [ms per call]": control.milliseconds,
    }


def tracking() -> dict[str, object]:
    """Published trajectories on the finite elements: distance to each goal after the approach."""
    result: dict[str, object] = {}
    for unilateral, word in ((True, "cables that pull"), (False, "cables that push too")):
        options = {"unilateral": unilateral}
        result |= _follow(f"Diamond, circle of 20 mm, {word}", "diamond", approach=30, calls=4, options=options)
        result |= _follow(
            f"three fingers, circle of a cube, {word}", "three_finger_gripper", approach=5, calls=3, options=options
        )
    for cables in (1, 2):
        goals = _finger_bending(cables)
        result |= _follow(
            f"finger, {cables} cable(s), quarter turn",
            "finger",
            goals=goals,
            approach=1,
            calls=4,
            options={"cables": cables},
        )
    result |= _follow("press of a button, 9 goals along y", "press_finger", approach=5, calls=4, weights=(0, 1, 0))
    result |= _follow(
        "bar of two fingers, x -30 to 30 mm", "two_finger_gripper", approach=1, calls=2, weights=(1, 1, 0)
    )
    result |= _follow("Stiff-Flop, circle of 40 mm, by volume", "trunk", goals=600, approach=200, calls=1)
    circle = "Stiff-Flop, circle of 40 mm, by pressure"
    result |= _embedded_trunk(f"{circle}, measured volumes (published 1.8)", encoders=True, calls=1)
    result |= _embedded_trunk(f"{circle}, predicted volumes (published 5)", calls=1)
    for stiffness in (0.8, 1.2):
        plant = f"{circle}, plant of {100 * stiffness:.0f} % stiffness"
        result |= _embedded_trunk(f"{plant}, open loop", stiffness=stiffness, calls=1)
    return result


CLOSED_LOOPS = {
    "PI gains of the thesis, one call per goal": ((0.01, 0.002), 1),
    # Its learned model made 3300 iterations in the 80 s of the path of 800 goals.
    "PI gains of the thesis, four calls per goal": ((0.01, 0.002), 4),
    "our PI gains, five calls per goal": ((0.3, 0.1), 5),
}
"""Proportional and integral gain, and controller calls per goal (thesis, sec. 4.4.4: 0.01 and 0.002)."""


def closed_loop() -> dict[str, object]:
    """Stiff-Flop, circle of 40 mm by pressure in a closed loop, on plants softer and stiffer than the model."""
    result: dict[str, object] = {}
    for stiffness in (0.8, 1.2):
        for name, (gains, calls) in CLOSED_LOOPS.items():
            title = f"plant of {100 * stiffness:.0f} % stiffness, {name}"
            result |= _embedded_trunk(title, stiffness=stiffness, gains=gains, calls=calls)
    return {key: value for key, value in result.items() if key.endswith(" [mm]")}


def predicted_path(
    robot_name: str, *, options: Mapping[str, object] | None = None, weights: object = None, calls: int = 6
) -> dict[str, float]:
    """Follow the reference path on the surrogate alone, with its predicted states, and replay the commands on FEM.

    Errors on the way to the first goal do not count. Distances are along the coordinates of the goal (``goal_axes``).

    Returns:
        The largest distance of prediction and FEM, and of FEM and goal [mm].
    """
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.backends.surrogate import SurrogateBackend
    from softgym_envs.control.inverse_qp import InverseQP
    from softgym_envs.robots.registry import make_robot

    robot = make_robot(robot_name, **dict(options or {}))
    fem, surrogate = FEMBackend(robot), SurrogateBackend(robot, weights=weights)  # type: ignore[arg-type]
    axes = np.asarray(robot.goal_axes, dtype=float)
    controller = InverseQP.for_robot(robot, goal_weights=axes)
    path = robot.reference_path()
    path = np.concatenate([np.linspace(surrogate.state.effector[0], path[0], 10, endpoint=False), path])
    gaps, misses = [], []
    for k, goal in enumerate(path):
        for _ in range(calls):
            state = surrogate.state
            surrogate.step(controller.solve(state.condensed, goal, state.command, state.slack))
            truth = fem.step(surrogate.state.command).effector[0]
        if k >= 10:
            gaps.append(np.linalg.norm(axes * (truth - surrogate.state.effector[0])))
            misses.append(np.linalg.norm(axes * (truth - goal)))
    return {"prediction to FEM, largest [mm]": 1e3 * max(gaps), "FEM to goal, largest [mm]": 1e3 * max(misses)}


def predicted_tracking() -> dict[str, object]:
    """Reference paths followed on the shipped surrogates with predicted states: distance of FEM from the prediction."""
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.pretrained import shipped_robots

    result: dict[str, object] = {}
    for variant, (name, options) in shipped_robots().items():
        if not make_robot(name, **options).convex:  # a part of grippers: see `shared_finger`
            continue
        # The published circle of the Diamond needs cables that push.
        given = {**options, "unilateral": False} if name == "diamond" else options
        result |= {f"{variant}: {k}": v for k, v in predicted_path(name, options=given).items()}
    return result


def shared_finger(bodies: int = 5, commands: int = 12) -> dict[str, object]:
    """The three-finger gripper made of one learned finger by symmetry, against the gripper in one FEM model.

    Random commands of its six cables on random bodies, then the published circle of the cube, followed on the learned
    fingers alone and replayed on FEM.
    """
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.control.finger_models import SurrogateFingers
    from softgym_envs.control.fingers import CoupledFingers
    from softgym_envs.control.inverse_qp import InverseQP
    from softgym_envs.errors import ConvergenceError
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.pretrained import pretrained_model

    gripper, model = make_robot("three_finger_gripper"), pretrained_model(make_robot("contact_finger"))
    rng = np.random.default_rng(0)
    gaps, tensions, compliances, failures = [], [], [], 0
    for body in range(bodies):
        design = gripper.design_space.sample(rng) if body else gripper.design_space.baseline
        fem = FEMBackend(gripper, design)
        learned = CoupledFingers.for_robot(gripper, SurrogateFingers(model, design), design)
        for _ in range(commands):
            command = rng.uniform(gripper.lower, gripper.upper)
            try:
                truth = fem.step(command)
                found = learned.solve(command)
            except ConvergenceError:
                failures += 1
                fem.reset()
                learned.reset()
                continue
            W, exact = found.condensed.compliance, truth.condensed.compliance
            gaps.append(np.linalg.norm(found.position - truth.effector[0]))
            tensions.append(np.abs(found.effort - truth.effort).max() / truth.effort.max())
            compliances.append(np.linalg.norm(W - exact) / np.linalg.norm(exact))
    result: dict[str, object] = {
        "states": len(gaps),
        "without an equilibrium of either": failures,
        "cube, mean [mm]": 1e3 * float(np.mean(gaps)),
        "cube, largest [mm]": 1e3 * float(np.max(gaps)),
        "tensions, of the largest, median [%]": 1e2 * float(np.median(tensions)),
        "W, median [%]": 1e2 * float(np.median(compliances)),
    }
    fem, learned = FEMBackend(gripper), CoupledFingers.for_robot(gripper, SurrogateFingers(model))
    controller = InverseQP.for_robot(gripper)
    path = gripper.reference_path()
    path = np.concatenate([np.linspace(learned.centre, path[0], 10, endpoint=False), path])
    command, state, solve, gaps, misses = np.zeros(6), learned.solve(np.zeros(6)), _Timer(), [], []
    for k, goal in enumerate(path):
        for _ in range(6):
            command = controller.solve(state.condensed, goal, command, state.slack)
            state = solve(learned.solve, command)
            truth = fem.step(command)
        if k >= 10:
            gaps.append(np.linalg.norm(truth.effector[0] - state.position))
            misses.append(np.linalg.norm(truth.effector[0] - goal))
    return result | {
        "circle of the cube: prediction to FEM, largest [mm]": 1e3 * max(gaps),
        "circle of the cube: FEM to goal, largest [mm]": 1e3 * max(misses),
        "circle of the cube: learned fingers [ms per call]": solve.milliseconds,
    }


def rest_compliance() -> dict[str, float]:
    """Compliance of the Stiff-Flop at rest, in the units of `PUBLISHED_COMPLIANCE`."""
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.stiff_flop import StiffFlop

    W = Statics(StiffFlop().build()).solve(np.zeros(6), "effort").condensed.W
    aa, ea, ee = 1e12 * W.aa, 1e6 * W.ea, W.ee
    values = (
        *(aa[0, 0], aa[0, 1], aa[3, 3], aa[3, 4]),
        *(ea[0, 0], ea[0, 3], ea[1, 2], ea[1, 5], -ea[2, 0], -ea[2, 3]),
        *(ee[0, 0], ee[1, 1]),
    )
    return dict(zip(PUBLISHED_COMPLIANCE, map(float, values), strict=True))


def _serial_beam(area: float, offset: float, section: float, inertia: float) -> np.ndarray:
    """The same by beam theory: a slender clamped beam of four pieces in series, without shear.

    Args:
        area: of a pair of chambers [mm2].
        offset: of its line of action from the axis [mm].
        section: area that carries load [mm2].
        inertia: second moment of area that carries load [mm4].
    """
    tip, chamber = 110.0, 50.0
    young, stiff = np.array([125.0, 70.0]), 1875.0
    starts = np.array([0.0, 55.0])
    axial, bending = young * section, young * inertia
    stretch = area**2 * chamber / axial
    turn = area**2 * offset**2 * chamber / bending
    lever = tip - starts - 0.5 * chamber
    aside = area * offset * chamber / bending * lever
    begin = np.array([0.0, 50.0, 55.0, 105.0])
    end = np.array([50.0, 55.0, 105.0, 110.0])
    modulus = np.array([young[0], stiff, young[1], stiff])
    xx = ((end - begin) / (modulus * section)).sum()
    yy = (((tip - begin) ** 3 - (tip - end) ** 3) / (3.0 * modulus * inertia)).sum()
    same, across = stretch + turn, stretch - 0.5 * turn
    along = area * chamber / axial
    sine = np.sqrt(0.75)
    return np.array(
        [same[0], across[0], same[1], across[1], *along, *(sine * aside), *aside, xx, yy],
    )


def infer_section() -> np.ndarray:
    """Chamber area, offset, section and inertia [mm] whose slender beam has the published compliance.

    Fits four numbers to twelve entries by the sum of the sixth powers of the relative errors, which the largest error
    dominates.
    """
    from scipy.optimize import least_squares

    published = np.array(list(PUBLISHED_COMPLIANCE.values()))

    def cubes(logarithms: np.ndarray) -> np.ndarray:
        return 100.0 * np.log(_serial_beam(*np.exp(logarithms)) / published) ** 3

    return np.exp(least_squares(cubes, np.log([3.35, 3.5, 31.0, 330.0]), xtol=1e-15, ftol=1e-15).x)


def stiff_flop() -> dict[str, object]:
    """Rest compliance of the Stiff-Flop against the published one, and its four inferred dimensions."""
    from softgym_envs.robots import stiff_flop as robot

    result: dict[str, object] = {}
    for name, ours in rest_compliance().items():
        published = PUBLISHED_COMPLIANCE[name]
        result[name] = f"ours {ours:.4f}, published {published:.4f}: {100.0 * (ours / published - 1.0):+.1f} %"
    area, offset, section, inertia = infer_section()
    radius = 5.75
    inferred = {
        "radius of one tube [mm]": (np.sqrt(area / (2.0 * np.pi)), 1e3 * robot.CHAMBER_RADIUS),
        "offset of a pair [mm]": (offset, 1e3 * robot.CHAMBER_OFFSET),
        "area that carries load, share of the disc": (section / (np.pi * radius**2), robot.AREA_SHARE),
        "inertia that carries load, share of the disc": (inertia / (0.25 * np.pi * radius**4), robot.INERTIA_SHARE),
    }
    for name, (value, used) in inferred.items():
        result[f"inferred {name}"] = f"{value:.4g} (used {used:.4g})"
    return result
