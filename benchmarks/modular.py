"""The modular arm on learned superelements against quadratic finite elements of its whole body."""

from __future__ import annotations

import time

import numpy as np

from softgym_envs.mechanics.condensation import RoleMatrix

ARMS = {
    "four leaves": (("leaf_x", "leaf_y") * 2, ((0.004, 0.0), (0.006, -0.005))),
    "eight leaves": (("leaf_x", "leaf_y") * 4, ((0.004, 0.0), (0.006, -0.005))),
    "leaves and blocks": (("leaf_x", "block", "leaf_y", "block"), ((0.002, 0.0), (0.003, -0.002))),
    # The wire in y bends this leaf about its stiff axis, under loads that were not learned.
    "leaf and block": (("leaf_x", "block"), ((0.002, 0.0), (0.002, 0.001))),
}
"""Cells of each arm, and commands of its wires [m]."""

RANDOM_BODIES = 2


def _held(W: RoleMatrix) -> np.ndarray:
    """Return the compliance of the tip with the wires held, shape (3, 3)."""
    return W.ee - W.ea @ np.linalg.solve(W.aa, W.ae)


def modular_arm() -> dict[str, object]:
    """Tip, compliance and speed of arms on superelements against finite elements, baseline and two random bodies."""
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.registry import make_robot

    result: dict[str, object] = {}
    seconds: dict[str, list[float]]
    for name, (cells, commands) in ARMS.items():
        rng = np.random.default_rng(0)
        robots = {body: make_robot("modular_arm", cells=cells, body=body) for body in ("superelements", "solid")}
        space = robots["solid"].design_space
        tip, compliance = [], []
        seconds = {body: [] for body in robots}
        for design in [space.baseline, *(space.sample(rng) for _ in range(RANDOM_BODIES))]:
            found = {}
            for body, robot in robots.items():
                solver = Statics(robot.build(design))
                states = []
                for command in commands:
                    began = time.process_time()
                    states.append(solver.solve(np.array(command)).condensed)
                    seconds[body].append(time.process_time() - began)
                rest = robot.build(design).constraints["e"][0].value(solver.model.nodes)
                found[body] = [(state.delta.e - rest, _held(state.W)) for state in states]
            for (moved, W), (true, exact) in zip(found["superelements"], found["solid"], strict=True):
                tip.append(100.0 * np.linalg.norm(moved - true) / np.linalg.norm(true))
                root = np.linalg.inv(np.linalg.cholesky(exact))
                compliance.append(100.0 * np.abs(np.linalg.eigvalsh(root @ W @ root.T) - 1.0).max())
        fast, slow = (float(np.median(seconds[body])) for body in ("superelements", "solid"))
        result |= {
            f"{name}: tip, mean error [% of its motion]": float(np.mean(tip)),
            f"{name}: tip, largest error [% of its motion]": float(np.max(tip)),
            f"{name}: compliance of the tip, wires held, largest error [%]": float(np.max(compliance)),
            f"{name}: superelements [CPU ms]": 1e3 * fast,
            f"{name}: finite elements [CPU s]": slow,
            f"{name}: times faster": slow / fast,
        }
    return result
