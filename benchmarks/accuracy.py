"""How accurate: surrogate against FEM."""

from __future__ import annotations

import numpy as np

GEOMETRIES = ((40, 20, 6, 1.03), (38.5, 21.5, 6, 3.11), (40, 20.5, 7.5, 7.02), (41, 21, 5.5, 1.62), (39.5, 20, 7, 5.10))
"""Length, height, joint height [mm] and the thesis' trajectory error [%] (Table 4.3)."""

ELASTICITIES = ((5000, 0.47, 0.91), (1000, 0.45, 0.29), (7000, 0.40, 0.90), (3000, 0.47, 1.03))
"""Young's modulus [kPa], Poisson's ratio and the thesis' trajectory error [%] (Table 4.3)."""


def test_set() -> dict[str, object]:
    """Errors on the untouched test sets over the whole design box, as recorded when the weights were made."""
    from softgym_envs.robots import make_robot
    from softgym_envs.surrogate.pretrained import pretrained_model

    result: dict[str, object] = {}
    for cables in (1, 2):
        card = pretrained_model(make_robot("finger", cables=cables)).card
        test = card["test"]
        result |= {
            f"{cables} cable(s): states in the test set": test["states"],
            f"{cables} cable(s): effector error, mean [mm]": 1e3 * test["effector_mean"],
            f"{cables} cable(s): effector error, worst [mm]": 1e3 * test["effector_worst"],
            f"{cables} cable(s): W relative Frobenius error, median [%]": 100 * test["compliance_median"],
            f"{cables} cable(s): W relative Frobenius error, worst [%]": 100 * test["compliance_worst"],
            f"{cables} cable(s): share with positive definite W": test["positive_definite"],
        }
    return result


def trajectories() -> dict[str, object]:
    """Closing trajectory of 25 goals on the thesis' designs: QP on the surrogate, its commands replayed on FEM.

    The goals are the FEM tip at 25 cable displacements from 0 to 20 mm. The error is that of the predicted tip
    positions, sqrt(sum |p_surrogate - p_FEM|^2) / sqrt(sum |p_FEM - p_rest|^2).
    """
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.backends.surrogate import SurrogateBackend
    from softgym_envs.control import InverseQP
    from softgym_envs.robots import make_robot

    robot = make_robot("finger", cables=1)
    cases = [
        (
            f"geometry {length}, {height}, {joint} mm",
            {"length": length, "height": height, "joint_height": joint},
            1e-3,
            published,
        )
        for length, height, joint, published in GEOMETRIES
    ] + [
        (f"elasticity {young} kPa, {nu}", {"young_modulus": young * 1e3, "poisson_ratio": nu}, 1.0, published)
        for young, nu, published in ELASTICITIES
    ]
    result: dict[str, object] = {}
    for name, values, unit, published in cases:
        design = {key: value * unit for key, value in values.items()}
        fem, surrogate = FEMBackend(robot, design), SurrogateBackend(robot, design)
        rest = fem.state.effector[0]
        goals = [fem.step(np.array([d])).effector[0] for d in np.linspace(0.0, 0.02, 25)]
        fem.reset()
        controller = InverseQP(robot.lower, robot.upper, robot.rates, np.array([True]))
        errors, moves = [], []
        for goal in goals:
            for _ in range(6):
                state = surrogate.state
                surrogate.step(controller.solve(state.condensed, goal, state.command, state.slack))
            truth = fem.step(surrogate.state.command).effector[0]
            errors.append(np.linalg.norm(truth - surrogate.state.effector[0]))
            moves.append(np.linalg.norm(truth - rest))
        relative = 100.0 * np.linalg.norm(errors) / np.linalg.norm(moves)
        result[f"{name}: error [%] (thesis {published} %)"] = float(relative)
        result[f"{name}: worst [mm]"] = 1e3 * float(np.max(errors))
    return result


def slack_states() -> dict[str, object]:
    """Both backends under 200 random commands of the two-cable finger over random designs, slack cables included."""
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.backends.surrogate import SurrogateBackend
    from softgym_envs.robots import make_robot

    robot = make_robot("finger")
    rng = np.random.default_rng(0)
    errors, slack, agree = [], [], []
    for _ in range(20):
        design = robot.design_space.sample(rng)
        fem, surrogate = FEMBackend(robot, design), SurrogateBackend(robot, design)
        for command in rng.uniform(robot.lower, robot.upper, (10, 2)):
            truth, guess = fem.probe(command), surrogate.probe(command)
            errors.append(1e3 * np.linalg.norm(truth.effector[0] - guess.effector[0]))
            slack.append(bool(truth.slack.any()))
            agree.append(bool((truth.slack == guess.slack).all()))
    return {
        "share of states with a slack cable": float(np.mean(slack)),
        "share where both agree which cables are slack": float(np.mean(agree)),
        "effector error, mean [mm]": float(np.mean(errors)),
        "effector error, worst [mm]": float(np.max(errors)),
        "effector error in slack states, mean [mm]": float(np.mean(np.array(errors)[slack])),
    }


def mesh_motion() -> dict[str, object]:
    """Noise of W_aa along a design line (joint height 5 to 8 mm, 31 designs): moved meshes against new ones.

    The noise is the standard deviation of the third differences, which a smooth curve does not have, over the mean.
    """
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.robots import make_robot

    result: dict[str, object] = {}
    for meshing in ("morph", "remesh"):
        robot = make_robot("finger", cables=1, meshing=meshing)
        line = [
            FEMBackend(robot, {"joint_height": joint}).state.condensed.W.aa[0, 0]
            for joint in np.linspace(5e-3, 8e-3, 31)
        ]
        noise = np.std(np.diff(line, 3)) / np.sqrt(20.0) / np.mean(line)  # sqrt of 1 + 9 + 9 + 1
        result[f"{meshing}: relative noise of W_aa"] = float(noise)
    return result
