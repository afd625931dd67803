"""The modular arm on learned superelements against quadratic finite elements of its whole body."""

from __future__ import annotations

import time

import numpy as np

from benchmarks.recorded import figure
from benchmarks.tables import markdown
from softgym_envs.mechanics.condensation import RoleMatrix

ARMS = {
    "four leaves": (("leaf_x", "leaf_y") * 2, ((0.004, 0.0), (0.006, -0.005))),
    "eight leaves": (("leaf_x", "leaf_y") * 4, ((0.004, 0.0), (0.006, -0.005))),
    "leaves and blocks": (("leaf_x", "block", "leaf_y", "block"), ((0.002, 0.0), (0.003, -0.002))),
    "hinges": (("notch_x", "notch_y") * 2, ((0.002, 0.0), (0.003, -0.002))),
    "tubes and accordions": (("tube", "accordion") * 2, ((0.002, 0.0), (0.003, -0.002))),
    "eight cells of all kinds": (
        ("leaf_x", "notch_y", "tube", "accordion", "leaf_y", "notch_x", "block", "accordion"),
        ((0.003, 0.0), (0.005, -0.004)),
    ),
    # The wire in y bends this leaf about its stiff axis, under loads that were not learned.
    "leaf and block": (("leaf_x", "block"), ((0.002, 0.0), (0.002, 0.001))),
}
"""Cells of each arm, and commands of its wires [m]."""

RANDOM_BODIES = 2


def _held(W: RoleMatrix) -> np.ndarray:
    """Return the compliance of the tip with the wires held, shape (3, 3)."""
    return W.ee - W.ea @ np.linalg.solve(W.aa, W.ae)


def modular_arm() -> dict[str, object]:
    """Tip, compliance and speed of arms on superelements against finite elements, baseline and two random bodies.

    Also the share of states whose tips differ by less than the uncertainty, its size, what it costs, and the smallest
    eigenvalue of ``W``, with rows and columns divided by the roots of its diagonal.
    """
    from softgym_envs.mechanics.solvers.learned_errors import possible_errors
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.registry import make_robot

    result: dict[str, object] = {}
    seconds: dict[str, list[float]]
    for name, (cells, commands) in ARMS.items():
        rng = np.random.default_rng(0)
        robots = {body: make_robot("modular_arm", cells=cells, body=body) for body in ("superelements", "solid")}
        space = robots["solid"].design_space
        tip, compliance, covered, bounds, trusted, definite, asked = [], [], [], [], [], [], []
        held = np.ones(2, dtype=bool)
        seconds = {body: [] for body in robots}
        for design in [space.baseline, *(space.sample(rng) for _ in range(RANDOM_BODIES))]:
            found = {}
            for body, robot in robots.items():
                solver = Statics(robot.build(design))
                states = []
                for command in commands:
                    began = time.process_time()
                    state = solver.solve(np.array(command))
                    states.append(state.condensed)
                    seconds[body].append(time.process_time() - began)
                    if body == "superelements":
                        began = time.process_time()
                        bounds.append(float(np.linalg.norm(possible_errors(solver, held))))
                        asked.append(time.process_time() - began)
                        trusted.append(all(block.knows(state.x) for block in solver.model.blocks))
                        W = state.condensed.compliance
                        root = 1.0 / np.sqrt(np.diag(W))
                        definite.append(float(np.linalg.eigvalsh(root[:, None] * W * root)[0]))
                rest = robot.build(design).constraints["e"][0].value(solver.model.nodes)
                found[body] = [(state.delta.e - rest, _held(state.W)) for state in states]
            for (moved, W), (true, exact) in zip(found["superelements"], found["solid"], strict=True):
                covered.append(np.linalg.norm(moved - true) <= bounds[len(tip)])
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
            f"{name}: states": len(tip),
            f"{name}: states with known loads and strains": sum(trusted),
            f"{name}: states within the uncertainty": int(sum(covered)),
            f"{name}: those of them with known loads and strains": sum(
                a and b for a, b in zip(covered, trusted, strict=True)
            ),
            f"{name}: uncertainty, median [mm]": 1e3 * float(np.median(bounds)),
            f"{name}: uncertainty [CPU ms]": 1e3 * float(np.median(asked)),
            f"{name}: smallest eigenvalue of W": min(definite),
        }
    return result


def modular_arm_table() -> str:
    """Arms on superelements against finite elements of the whole body."""

    def cell(name: str, key: str, form: str, unit: str) -> str:
        return figure("modular_arm", f"{name}: {key}", form) + unit

    rows = [
        [
            name,
            cell(name, "tip, mean error [% of its motion]", ".2f", " %")
            + ", "
            + cell(name, "tip, largest error [% of its motion]", ".2f", " %"),
            cell(name, "compliance of the tip, wires held, largest error [%]", ".1f", " %"),
            cell(name, "superelements [CPU ms]", ".0f", " ms"),
            cell(name, "finite elements [CPU s]", ".1f", " s"),
            cell(name, "times faster", ".0f", ""),
            cell(name, "uncertainty, median [mm]", ".2g", " mm")
            + ", "
            + cell(name, "states within the uncertainty", ".0f", "")
            + " of "
            + cell(name, "states", ".0f", ""),
        ]
        for name in ARMS
    ]
    head = ["arm", "tip: mean and largest error", "compliance of the tip, wires held: largest error"]
    return markdown([*head, "superelements", "finite elements", "times", "uncertainty; holds in"], rows, "lrrrrrr")


def module_energies_table() -> str:
    """Errors of the learned energies that come with the package, on bodies that were not learned."""
    from softgym_envs.robots.modules import learned_module
    from softgym_envs.robots.modules.learning import RECIPES

    rows = []
    for name in RECIPES:
        learned = learned_module(name)
        for place, found in sorted(learned.errors.items(), reverse=True):
            percent = {of: 100.0 * error for of, error in found.items()}
            cells = [f"{percent[f'{of}_mean']:.2g} %, {percent[f'{of}_max']:.2g} %" for of in ("strain", "stiffness")]
            first = [f"`{name}`", f"{learned.rotation:g}"] if place == "inside" else ["", ""]
            rows.append([*first, place, *cells])
    head = ["module", "load [rad]", "bodies", "strains: mean, largest", "stiffness: mean, largest"]
    return markdown(head, rows, "lrlrr")


TABLES = {"modular_arm": modular_arm_table, "module_energies": module_energies_table}
"""Tables of pages by name."""
