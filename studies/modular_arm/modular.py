"""The modular arm on learned superelements against quadratic finite elements of its whole body."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.recorded import figure, records, results
from benchmarks.tables import markdown
from softgym_envs.mechanics.condensation import CondensedModel, RoleMatrix
from softgym_envs.mechanics.elements.superelement import Superelement
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.robots.modular_arm import ModularArm

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


def _largest(found: np.ndarray, true: np.ndarray) -> float:
    """Return the largest error of a stiffness or compliance over all directions [%]."""
    root = np.linalg.inv(np.linalg.cholesky(true))
    return 100.0 * float(np.abs(np.linalg.eigvalsh(root @ found @ root.T) - 1.0).max())


def _errors(found: CondensedModel, true: CondensedModel, rest: np.ndarray) -> tuple[float, float]:
    """Return the errors of a state: tip [% of its motion from ``rest`` (3,)] and compliance, wires held [%]."""
    tip = np.linalg.norm(found.delta.e - true.delta.e) / np.linalg.norm(true.delta.e - rest)
    return 100.0 * float(tip), _largest(_held(found.W), _held(true.W))


@dataclass(frozen=True)
class Expanded:
    """Energy of a module to second order about one state, where its force and its stiffness are exact.

    Attributes:
        strains: of the state [m, 1], shape (6,).
        gradient: of the energy at the state, shape (6,) [N, N m].
        hessian: of the energy at the state, shape (6, 6).
    """

    strains: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray

    def evaluate(self, strains: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        off = strains - self.strains
        force = self.gradient + self.hessian @ off
        return 0.5 * float((self.gradient + force) @ off), force, self.hessian

    def knows(self, strains: np.ndarray) -> bool:
        return True


CHANGE = 1e-8
"""Largest change of the frames of an exact arm [m, 1] by its last step."""


def superelements(model: MechanicalModel) -> list[Superelement]:
    """Return the superelements of an arm from the base to the tip."""
    return [block for block in model.blocks if isinstance(block, Superelement)]


class ExactArm:
    """An arm of superelements whose energies are exact where it is: condensed from finite elements of each module.

    Its equilibria and condensed models are those of the finite elements of the whole body, because the ports are rigid.

    Args:
        cells: from the base to the tip.
        design: complete.

    Attributes:
        model: the arm.
        names: of its modules.
        designs: of its modules.
    """

    def __init__(self, cells: Sequence[str], design: Mapping[str, float]) -> None:
        from softgym_envs.mechanics.solvers.statics import Statics
        from softgym_envs.robots.modular_arm import CELLS
        from softgym_envs.robots.modules import MODULES, learned_module

        self.model = ModularArm(cells=cells).build(design)
        self.names = [CELLS[cell][0] for cell in cells]
        self.designs = [
            {dimension: design[f"{dimension}_{number}"] for dimension in learned_module(name).box}
            | {"young_modulus": design["young_modulus"]}
            for number, name in enumerate(self.names, start=1)
        ]
        self._axes = [CELLS[cell][1] for cell in cells]
        self._parts = [Statics(MODULES[n]().model(own)) for n, own in zip(self.names, self.designs, strict=True)]

    def energies(self, x: np.ndarray) -> list[Expanded]:
        """Return the energy of each module about a state with frames ``x`` (n, 3), its ports held where they are."""
        from softgym_envs.robots.modules.states import MODULUS, in_strains

        found = []
        for part, block, axes in zip(self._parts, superelements(self.model), self._axes, strict=True):
            near, far = np.split(x[block.rows], 2)
            turned = near[1:].T @ axes
            rows = part.model.nodes.copy()
            rows[-4] = (far[0] - near[0]) @ turned
            rows[-3:] = axes.T @ far[1:] @ turned
            pose = np.concatenate([constraint.value(rows) for constraint in part.model.constraints["a"]])
            strain, gradient, hessian, *_ = in_strains(part.solve(pose).condensed, block.length)
            scale, unit = np.array([block.length] * 3 + [1.0] * 3), MODULUS * block.length**3
            found.append(Expanded(scale * strain, unit * gradient / scale, unit * hessian / np.outer(scale, scale)))
        return found

    def solve(self, command: np.ndarray, start: Equilibrium) -> tuple[Equilibrium, list[Expanded]]:
        """Return the equilibrium under a command, and the energies about it, by Newton's method from a state."""
        from softgym_envs.mechanics.solvers.statics import Statics

        state = start
        while True:
            energies = self.energies(state.x)
            for block, energy in zip(superelements(self.model), energies, strict=True):
                block.energy = energy
            solver, last = Statics(self.model), state.x
            solver.restore(state.x, state.effort)
            state = solver.solve(command)
            if np.abs(state.x - last).max() < CHANGE:
                return state, energies


EVERYTHING = "all modules"


def kinds() -> dict[str, object]:
    """Errors of the arm of eight cells of all kinds, also if only the modules of one kind have learned energies.

    Bodies and commands are those of its comparison with finite elements of the whole body, whose states are found here
    from finite elements of the modules. Also the errors of the stiffness of the modules at rest and in these states,
    and the share of dimensions at the bounds of their box of the body that is worst at rest.
    """
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.modules import learned_module

    cells, commands = ARMS["eight cells of all kinds"]
    robot, rng = ModularArm(cells=cells), np.random.default_rng(0)
    space = robot.design_space
    errors: dict[str, list[tuple[float, float]]] = {}
    stiffness: dict[str, list[tuple[float, float, float]]] = {}
    for design in [space.baseline, *(space.sample(rng) for _ in range(RANDOM_BODIES))]:
        solver, arm = Statics(robot.build(design)), ExactArm(cells, space.complete(design))
        learned = [block.energy for block in superelements(solver.model)]
        rest = solver.model.constraints["e"][0].value(solver.model.nodes)
        at_rest = [
            _largest(energy.evaluate(exact.strains)[2], exact.hessian)
            for energy, exact in zip(learned, arm.energies(solver.model.nodes), strict=True)
        ]
        for command in np.array(commands):
            true, about = arm.solve(command, solver.solve(command))
            for which in (EVERYTHING, *dict.fromkeys(arm.names)):
                for name, block, *energies in zip(arm.names, superelements(arm.model), about, learned, strict=True):
                    block.energy = energies[which in (EVERYTHING, name)]
                other = Statics(arm.model)
                other.restore(true.x, true.effort)
                found = _errors(other.solve(command).condensed, true.condensed, rest)
                errors.setdefault(which, []).append(found)
            for name, own, *energies, unloaded in zip(arm.names, arm.designs, about, learned, at_rest, strict=True):
                module, exact = learned_module(name), energies[0]
                edge = module.edge_share(module.unit(np.array([[own[dimension] for dimension in module.box]])))[0]
                loaded = _largest(energies[1].evaluate(exact.strains)[2], exact.hessian)
                stiffness.setdefault(name, []).append((unloaded, loaded, float(edge)))
    result: dict[str, object] = {}
    for which, pairs in errors.items():
        tip, compliance = np.max(pairs, axis=0)
        result[f"{which} learned: tip, largest error [% of its motion]"] = float(tip)
        result[f"{which} learned: compliance of the tip, wires held, largest error [%]"] = float(compliance)
    for name, triples in stiffness.items():
        result[f"{name}: stiffness at rest, largest error [%]"] = max(triples)[0]
        result[f"{name}: stiffness in the states, largest error [%]"] = max(triple[1] for triple in triples)
        result[f"{name}: share of dimensions at their bounds, worst body at rest"] = max(triples)[2]
    return result


def compare(name: str) -> dict[str, object]:
    """Return tip, compliance and speed of an arm on superelements against finite elements of the whole body.

    Baseline and two random bodies. Also how often both bodies agree whether a state is stable, the smallest eigenvalue
    of ``W`` in stable states, with rows and columns divided by the roots of its diagonal, and the share of states whose
    tips differ by less than the uncertainty, its size, and what it costs.
    """
    from softgym_envs.mechanics.solvers.learned_errors import possible_errors
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.registry import make_robot

    cells, commands = ARMS[name]
    rng = np.random.default_rng(0)
    robots = {body: make_robot("modular_arm", cells=cells, body=body) for body in ("superelements", "solid")}
    space = robots["solid"].design_space
    held = np.ones(2, dtype=bool)
    seconds: dict[str, list[float]] = {body: [] for body in robots}
    tip, compliance, covered, bounds, trusted, asked, definite, agree = [], [], [], [], [], [], [], []
    for design in [space.baseline, *(space.sample(rng) for _ in range(RANDOM_BODIES))]:
        solvers = {body: Statics(robot.build(design)) for body, robot in robots.items()}
        rest = solvers["solid"].model.constraints["e"][0].value(solvers["solid"].model.nodes)
        before = np.zeros(2)
        for command in np.array(commands):
            found = {}
            for body, solver in solvers.items():
                began = time.process_time()
                # Finite elements of some bodies need twice the iterations in one step.
                solver.solve(0.5 * (before + command))
                found[body] = solver.solve(command)
                seconds[body].append(time.process_time() - began)
            before = command
            began = time.process_time()
            bounds.append(float(np.linalg.norm(possible_errors(solvers["superelements"], held))))
            asked.append(time.process_time() - began)
            learned, true = found["superelements"], found["solid"]
            blocks = solvers["superelements"].model.blocks
            trusted.append(learned.stable and all(block.knows(learned.x) for block in blocks))
            agree.append(learned.stable == true.stable)
            if learned.stable:
                W = learned.condensed.compliance
                root = 1.0 / np.sqrt(np.diag(W))
                definite.append(float(np.linalg.eigvalsh(root[:, None] * W * root)[0]))
            off = np.linalg.norm(learned.condensed.delta.e - true.condensed.delta.e)
            covered.append(bool(off <= bounds[-1]))
            errors = _errors(learned.condensed, true.condensed, rest)
            tip.append(errors[0])
            compliance.append(errors[1])
    fast, slow = (float(np.median(seconds[body])) for body in ("superelements", "solid"))
    known = np.array(trusted)
    return {
        "tip, mean error [% of its motion]": float(np.mean(tip)),
        "tip, largest error [% of its motion]": float(np.max(tip)),
        "compliance of the tip, wires held, mean error [%]": float(np.mean(compliance)),
        "compliance of the tip, wires held, largest error [%]": float(np.max(compliance)),
        "tip, trusted states, largest error [% of its motion]": float(np.array(tip)[known].max(initial=0.0)),
        "compliance of the tip, trusted states, largest error [%]": float(np.array(compliance)[known].max(initial=0.0)),
        "superelements [CPU ms]": 1e3 * fast,
        "finite elements [CPU s]": slow,
        "times faster": slow / fast,
        "states": len(tip),
        "trusted states": int(known.sum()),
        "stable states": len(definite),
        "states with the stability of finite elements": sum(agree),
        "smallest eigenvalue of W, stable states": min(definite),
        "states within the uncertainty": sum(covered),
        "trusted states within the uncertainty": int(np.array(covered)[known].sum()),
        "uncertainty, median [mm]": 1e3 * float(np.median(bounds)),
        "uncertainty [CPU ms]": 1e3 * float(np.median(asked)),
    }


def of(name: str) -> Callable[[], dict[str, object]]:
    """Return the benchmark of one arm."""

    def run() -> dict[str, object]:
        return compare(name)

    run.__doc__ = f"The modular arm '{name}' on superelements against finite elements of its whole body."
    return run


def benchmark(name: str) -> str:
    """Return the name of the benchmark of an arm."""
    return f"modular_arm_{name.replace(' ', '_')}"


def stability() -> dict[str, object]:
    """How often random arms are stable: of up to eight cells, at rest, and under two commands of up to 4 mm."""
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.modular_arm import CELLS
    from softgym_envs.robots.registry import make_robot

    kinds, rng, arms = [kind for kind in CELLS if kind != "bellows"], np.random.default_rng(5), 150
    counts = {"states": 0, "stable": 0, "modules know their loads": 0, "of these unstable": 0, "unstable at rest": 0}
    counts |= {"stable with an indefinite W": 0}
    for _ in range(arms):
        chosen = [kinds[k] for k in rng.integers(0, len(kinds), int(rng.integers(1, 9)))]
        robot = make_robot("modular_arm", cells=chosen)
        solver = Statics(robot.build(robot.design_space.sample(rng)))
        for share in (0.0, 0.5, 1.0):
            state = solver.solve(share * rng.uniform(-0.004, 0.004, 2))
            known = all(block.knows(state.x) for block in solver.model.blocks)
            counts["states"] += 1
            counts["stable"] += state.stable
            counts["modules know their loads"] += known
            counts["of these unstable"] += known and not state.stable
            counts["unstable at rest"] += share == 0.0 and not state.stable
            indefinite = np.linalg.eigvalsh(state.condensed.compliance)[0] <= 0.0
            counts["stable with an indefinite W"] += state.stable and bool(indefinite)
    return {"arms": arms, **{name: int(count) for name, count in counts.items()}}


MEMBERS, SHARE = 4, 0.75
"""Energies of the ensembles that are compared with calibrated bounds, and the share of bodies that each learns."""


def module_bounds() -> dict[str, object]:
    """Bounds on errors of strains from the place in the box alone, and from the spread of an ensemble of energies.

    Every fifth of the bodies is predicted by an energy that learned the others, and by the members of an ensemble that
    learned different parts of these. Each scale of the errors is multiplied so that 95 % of all states are within it;
    the better scale gives narrower bounds.
    """
    from scipy.stats import spearmanr

    from softgym_envs.robots.modules import learning

    result: dict[str, object] = {}
    for name in ("solid_block", "crossed_leaves"):
        recipe = learning.RECIPES[name]
        states = learning.training_states(name, recipe)
        _, body = np.unique(states.designs, axis=0, return_inverse=True)
        fold, moved, rng = learning.folds(states), (states.strain != 0.0).any(axis=1), np.random.default_rng(1)
        wrong, spread, share = [], [], []
        for part in range(learning.FOLDS):
            left = states.rows((fold == part) & moved)
            others = np.unique(body[fold != part])
            drawn = [rng.choice(others, int(SHARE * len(others)), replace=False) for _ in range(MEMBERS)]
            models = [learning.fit(recipe, name, states.rows(np.isin(body, some)), {}) for some in (others, *drawn)]
            found = np.array([learning.strain_errors(model, left) for model in models])
            sizes = np.linalg.norm(left.strain, axis=1)
            wrong.append(np.linalg.norm(found[0], axis=1) / sizes)
            spread.append(np.sqrt(found[1:].var(axis=0).sum(axis=1)) / sizes)
            share.append(models[0].edge_share(models[0].unit(left.designs)))
        error, spreads, shares = (np.concatenate(each) for each in (wrong, spread, share))
        slope = max(float(np.polyfit(shares, np.log(error), 1)[0]), 0.0)
        scales = {
            "place": np.exp(slope * shares),
            "ensemble": np.hypot(spreads, np.median(spreads)),
        }
        result[f"{name}: error of the strains, median [%]"] = 100.0 * float(np.median(error))
        for scale, values in scales.items():
            factor = np.quantile(error / values, learning.CONFIDENCE)
            result[f"{name}: bound from the {scale}, median [%]"] = 100.0 * float(np.median(factor * values))
            result[f"{name}: rank correlation of the {scale} with the error"] = float(spearmanr(values, error)[0])
    return result


def accordion_fits() -> dict[str, object]:
    """Stiffness at rest of the accordions of the arm of eight cells, by fits to states at rest alone.

    The fits learn the bodies of the recipe, with and without the corners of its box, and have corrections of first and
    of second degree in the logarithms of the dimensions. Errors are the largest over all directions of motion.
    """
    from dataclasses import replace

    from softgym_envs.robots.modular_arm import CELLS
    from softgym_envs.robots.modules import MODULES, learned_module, learning
    from softgym_envs.robots.modules.learned import polynomials
    from softgym_envs.robots.modules.states import solve_states

    name, (cells, _) = "accordion", ARMS["eight cells of all kinds"]
    recipe, dimensions = learning.RECIPES[name], tuple(learning.RECIPES[name].box)
    space, rng = ModularArm(cells=cells).design_space, np.random.default_rng(0)
    arms = [space.complete({}), *(space.sample(rng) for _ in range(RANDOM_BODIES))]
    places = [number for number, cell in enumerate(cells, start=1) if CELLS[cell][0] == name]
    bodies = np.array([[arm[f"{dimension}_{place}"] for dimension in dimensions] for arm in arms for place in places])
    true = solve_states(MODULES[name](), bodies, dimensions, rotation=recipe.rotation, rays=0, rng=rng)
    result: dict[str, object] = {"accordions": len(bodies)}
    every = learning.training_states(name, replace(recipe, rays=0, corners=True))  # one a body, the corners last
    for corners in (False, True):
        states = every if corners else every.rows(np.arange(len(every)) < recipe.unloaded + recipe.bodies)
        for degree, text in ((1, "first"), (2, "second")):
            model = replace(learned_module(name), degrees=(recipe.degrees[0], degree))
            P, Q = (polynomials(model.unit(states.designs), each) for each in model.degrees)
            found = learning._guess_at_rest(model, states, P, Q)
            errors = learning.stiffness_errors(found, true)
            key = f"{'with' if corners else 'without'} corners, corrections of {text} degree: largest error [%]"
            result[key] = 100.0 * float(errors.max())
    return result


def module_meshes() -> dict[str, object]:
    """By how much half as long edges make modules softer or stiffer, in the directions of motion of the extremes."""
    from softgym_envs.robots.modules import MODULES
    from softgym_envs.robots.modules.learning import RECIPES

    result: dict[str, object] = {}
    for name, recipe in RECIPES.items():
        design = {dimension: 0.5 * (low + high) for dimension, (low, high) in recipe.box.items()}
        usual, fine = (MODULES[name]().compliance(design, refine=refine) for refine in (1.0, 2.0))
        root = np.linalg.inv(np.linalg.cholesky(usual))
        result[f"{name}: softer [%]"] = 100.0 * float(np.linalg.eigvalsh(root @ fine @ root.T)[-1] - 1.0)
        result[f"{name}: stiffer [%]"] = 100.0 * float(1.0 - np.linalg.eigvalsh(root @ fine @ root.T)[0])
    return result


BENCHMARKS = {benchmark(name): of(name) for name in ARMS} | {
    "modular_arm_kinds": kinds,
    "accordion_fits": accordion_fits,
    "modular_arm_stability": stability,
    "module_bounds": module_bounds,
    "module_meshes": module_meshes,
}
"""Each arm is a benchmark of its own, because the arm of eight cells takes minutes; so are bounds and meshes."""


def modular_arm_table() -> str:
    """Arms on superelements against finite elements of the whole body, those that are recorded."""
    rows = []
    for name in (each for each in ARMS if benchmark(each) in records()):

        def cell(key: str, form: str, unit: str = "", recorded: str = benchmark(name)) -> str:
            return figure(recorded, key, form) + unit

        kinds = [
            [
                cell(f"tip, {which}largest error [% of its motion]", ".2f", " %"),
                cell(f"compliance of the tip, {held}, largest error [%]", ".1f", " %"),
            ]
            for which, held in (("", "wires held"), ("trusted states, ", "trusted states"))
        ]
        rows.append(
            [
                name,
                *(f"{everywhere} ({where_trusted})" for everywhere, where_trusted in zip(*kinds, strict=True)),
                f"{cell('trusted states', '')} of {cell('states', '')}",
                cell("superelements [CPU ms]", ".0f", " ms"),
                cell("finite elements [CPU s]", ".1f", " s"),
            ]
        )
    head = ["arm", "tip: largest error", "compliance of the tip, wires held: largest error", "trusted"]
    return markdown([*head, "superelements", "finite elements"], rows, "lrrrrr")


def modular_arm_kinds_table() -> str:
    """Errors of the arm of eight cells if all modules, or only those of one kind, have learned energies."""
    rows, end = [], " learned: tip, largest error [% of its motion]"
    for which in (name.removesuffix(end) for name in results("modular_arm_kinds") if name.endswith(end)):
        keys = [end, " learned: compliance of the tip, wires held, largest error [%]"]
        if which != EVERYTHING:
            keys += [f": stiffness {where}, largest error [%]" for where in ("at rest", "in the states")]
        errors = [figure("modular_arm_kinds", which + key, ".2f") + " %" for key in keys]
        rows.append([which if which == EVERYTHING else f"only `{which}`", *errors, *[""] * (4 - len(errors))])
    head = ["learned energies", "tip: largest error", "compliance of the tip, wires held: largest error"]
    return markdown([*head, "stiffness of such modules at rest", "in the states"], rows, "lrrrr")


def module_energies_table() -> str:
    """Errors of the learned energies that come with the package, on bodies that were not learned."""
    from softgym_envs.robots.modules import learned_module
    from softgym_envs.robots.modules.learning import RECIPES

    rows, meshes = [], results("module_meshes")
    for name in RECIPES:
        learned = learned_module(name)
        for place, found in sorted(learned.errors.items(), reverse=True):
            percent = {of: 100.0 * error for of, error in found.items()}
            cells = [f"{percent[f'{of}_mean']:.2g} %, {percent[f'{of}_max']:.2g} %" for of in ("strain", "stiffness")]
            first, mesh = ["", ""], ""
            if place == "inside":
                first = [f"`{name}`", f"{learned.rotation:g}"]
                mesh = f"{max(meshes[f'{name}: {way} [%]'] for way in ('softer', 'stiffer')):.1f} %"
            bound = f"{100.0 * np.linalg.norm(learned.bounds[place]):.2g} %"
            within = f"{100.0 * found['covered']:.0f} % of {6 * found['loaded']:.0f}"
            rows.append([*first, place, *cells, bound, within, mesh])
    head = ["module", "load [rad]", "bodies", "strains: mean, largest", "stiffness: mean, largest"]
    return markdown([*head, "bound", "errors within it", "mesh"], rows, "lrlrrrrr")


def module_bounds_table() -> str:
    """Calibrated bounds of two modules against those from the spread of an ensemble."""
    rows = []
    for name in ("solid_block", "crossed_leaves"):
        keys = [f"bound from the {scale}, median [%]" for scale in ("place", "ensemble")]
        keys = ["error of the strains, median [%]", *keys]
        rows.append([f"`{name}`", *(figure("module_bounds", f"{name}: {key}", ".2f") + " %" for key in keys)])
    head = ["module", "error: median", "bound from the place in the box: median", "from an ensemble: median"]
    return markdown(head, rows, "lrrr")


TABLES = {
    "modular_arm": modular_arm_table,
    "modular_arm_kinds": modular_arm_kinds_table,
    "module_energies": module_energies_table,
    "module_bounds": module_bounds_table,
}
"""Tables of pages by name."""
