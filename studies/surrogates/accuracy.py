"""Accuracy of the surrogates, compared with FEM."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from softgym_envs.robots.base import Robot

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "surrogate"

GEOMETRIES = ((40, 20, 6, 1.03), (38.5, 21.5, 6, 3.11), (40, 20.5, 7.5, 7.02), (41, 21, 5.5, 1.62), (39.5, 20, 7, 5.10))
"""Length, height, joint height [mm] and the thesis' trajectory error [%] (Table 4.3)."""

ELASTICITIES = ((5000, 0.47, 0.91), (1000, 0.45, 0.29), (7000, 0.40, 0.90), (3000, 0.47, 1.03))
"""Young's modulus [kPa], Poisson's ratio and the thesis' trajectory error [%] (Table 4.3)."""


def test_set(folder: str | Path = "results/test_set", workers: int = 2) -> dict[str, object]:
    """Errors of the shipped weights on their test sets, whose FEM states are computed again (minutes for some robots).

    Weights with sensors and those of other meshes than the published one have rows of their own.
    States that `stable_rows` excludes from training, because they are about to buckle, are reported separately.
    """
    from softgym_envs.config import load_config
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.data.dataset import generate_dataset
    from softgym_envs.surrogate.data.states import full_compliance, stable_rows
    from softgym_envs.surrogate.pretrained import pretrained_folder, pretrained_model, shipped_robots
    from softgym_envs.surrogate.training import FitConfig

    result: dict[str, object] = {}
    for variant, (name, options) in shipped_robots().items():
        robot = make_robot(name, **options)
        if len(robot.sensor_scale) or "mesh" in options:
            continue
        model = pretrained_model(robot)
        plan = load_config(CONFIGS / f"{variant}.yaml", FitConfig).data.plan("test")
        data = generate_dataset(Path(folder) / variant, name, plan, robot_options=options, workers=workers)
        context = model.context(data["design"])
        _, effector, spread = model.state(context, data["displacement"])
        off = np.linalg.norm((effector - data["effector"]).reshape(len(effector), -1, 3), axis=2).max(axis=1)
        uncertainty, trusted = model.trust(context, data["displacement"], spread)
        kept = stable_rows(robot, data)
        size = sum(path.stat().st_size for path in pretrained_folder(robot).iterdir())
        result |= {
            f"{variant}: states for training / in the test set": f"{model.card['states']['train']} / {kept.sum()}",
            f"{variant}: effector error, mean [mm]": 1e3 * float(off[kept].mean()),
            f"{variant}: effector error, worst [mm]": 1e3 * float(off[kept].max()),
            f"{variant}: effector errors below the uncertainty [%]": 100 * float((off <= uncertainty)[kept].mean()),
            f"{variant}: trusted [%]": 100 * float(trusted[kept].mean()),
        }
        # FEM on the robot's own mesh knows nothing of the correction for its error.
        correction = model.correction.factor(model.features.design(data["design"]))
        W = (model.compliance(context, data["displacement"]) * correction[:, :, None])[kept]
        truth = full_compliance(data["compliance"], model.size)[kept]
        a, e = slice(0, model.count), slice(model.count, None)
        for label, rows, columns in (("between actuators", a, a), ("actuators to effector", e, a), ("effector", e, e)):
            block, exact = W[:, rows, columns], truth[:, rows, columns]
            relative = np.linalg.norm(block - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
            result[f"{variant}: W, {label}, relative error, median [%]"] = 100 * float(np.median(relative))
        result[f"{variant}: left out as about to buckle [% of the states]"] = 100 * float((~kept).mean())
        if not kept.all():
            left = ~kept
            result |= {
                f"{variant}: left out: effector error, mean [mm]": 1e3 * float(off[left].mean()),
                f"{variant}: left out: effector error, worst [mm]": 1e3 * float(off[left].max()),
                f"{variant}: left out: trusted all the same [%]": 100 * float(trusted[left].mean()),
                f"{variant}: left out: errors below the uncertainty [%]": 100
                * float((off <= uncertainty)[left].mean()),
            }
            if (left & trusted).any():
                result |= {
                    f"{variant}: left out and trusted: effector error, mean [mm]": 1e3
                    * float(off[left & trusted].mean()),
                    f"{variant}: left out and trusted: effector error, worst [mm]": 1e3
                    * float(off[left & trusted].max()),
                }
        result |= {
            f"{variant}: trusted below an uncertainty of [mm]": 1e3 * model.card["domain"].get("limit", np.nan),
            f"{variant}: size of the files [kB]": size / 1e3,
        }
    return result


def positive_definite(count: int = 1_000_000) -> dict[str, object]:
    """Check in a million random states of every robot that W is positive definite and equals the derivative of delta.

    The derivative of the predicted state is taken by central differences in the last 10,000 states. Errors are relative
    to the largest entry of the same state; the network computes in single precision.
    """
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.pretrained import pretrained_model, shipped_robots

    result: dict[str, object] = {}
    for variant, (name, options) in shipped_robots().items():
        robot = make_robot(name, **options)
        if not robot.convex:  # its energy is not convex
            continue
        model = pretrained_model(robot)
        rng = np.random.default_rng(0)
        low, high = (np.array([getattr(v, end) for v in robot.design_space]) for end in ("low", "high"))
        good, smallest = 0, np.inf
        for _ in range(-(-count // 10_000)):
            designs = rng.uniform(low, high, (1000, len(low)))
            context = model.context(designs).rows(np.repeat(np.arange(1000), 10))
            displacement = rng.uniform(robot.lower, robot.upper, (10_000, model.count))
            W = model.compliance(context, displacement)
            scale = np.sqrt(np.einsum("bii->bi", W))
            least = np.linalg.eigvalsh(W / scale[:, :, None] / scale[:, None, :])[:, 0]
            symmetric = (W == W.swapaxes(1, 2)).all(axis=(1, 2))
            good += int((symmetric & (least > 0.0)).sum())
            smallest = min(smallest, float(least.min()))
        result[f"{variant}: symmetric positive definite [%]"] = 100 * good / (-(-count // 10_000) * 10_000)
        result[f"{variant}: smallest eigenvalue, rows scaled to a diagonal of 1"] = smallest
        n = model.count
        K = np.linalg.inv(W[:, :n, :n])
        J = W[:, n:, :n] @ K
        worst = np.zeros(2)  # of efforts and of the effector
        for k in range(n):
            step = np.zeros(n)
            step[k] = 2e-3 * (robot.upper - robot.lower)[k]
            up, down = model.state(context, displacement + step), model.state(context, displacement - step)
            for which, exact in enumerate((K, J)):
                off = np.abs((up[which] - down[which]) / (2 * step[k]) - exact[:, :, k]).max(axis=1)
                worst[which] = max(worst[which], float((off / np.abs(exact).max(axis=(1, 2))).max()))
        result[f"{variant}: d effort / d delta against W, largest difference"] = float(worst[0])
        result[f"{variant}: d effector / d delta against W, largest difference"] = float(worst[1])
    return result


def design_gradients(bodies: int = 12) -> dict[str, object]:
    """Derivative of the effector by each design variable at held actuators: surrogate against differences of FEM.

    The error of a body is the norm of the difference of the two gradients, in units of the variables' ranges, relative
    to that of FEM; FEM differences are central over 2 % of a variable's range, on moved meshes.
    """
    import torch

    from softgym_envs.errors import ConvergenceError, InfeasibleDesign
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.features import learned_variables
    from softgym_envs.surrogate.potential.torch import TorchModel
    from softgym_envs.surrogate.pretrained import pretrained_model, shipped_robots

    result: dict[str, object] = {}
    for variant, (name, options) in shipped_robots().items():
        robot = make_robot(name, **options)
        net = TorchModel(pretrained_model(robot))
        space = robot.design_space
        rng = np.random.default_rng(5)
        errors = []
        for _ in range(bodies):
            design = {k: v.low + rng.uniform(0.05, 0.95) * (v.high - v.low) for k, v in space.variables.items()}
            try:
                # Hold the actuators at displacements that real cables can have, taut or slack.
                statics = Statics(robot.build(design))
                statics.solve(np.zeros(len(robot.actuators)), robot.rest_mode)
                held = statics.solve(robot.displacements(rng.random((1, net.model.count)))[0]).condensed.delta.a
                exact = {}
                for variable in learned_variables(robot):
                    h = 0.01 * (space[variable].high - space[variable].low)
                    ends = []
                    for sign in (1.0, -1.0):
                        moved = Statics(robot.build({**design, variable: design[variable] + sign * h}))
                        moved.unilateral = np.zeros_like(moved.unilateral)
                        for part in (0.25, 0.5, 0.75, 1.0):
                            found = moved.solve(part * held)
                        ends.append(found.condensed.delta.e)
                    exact[variable] = (ends[0] - ends[1]) / (2 * h)
            except (ConvergenceError, InfeasibleDesign):
                continue
            values = torch.tensor([[design[k] for k in space.names]], dtype=torch.float64, requires_grad=True)
            effector = net(values, torch.as_tensor(held[None]))[1]
            rows = [
                torch.autograd.grad(effector[0, k], values, retain_graph=True)[0][0] for k in range(effector.shape[1])
            ]
            jacobian = torch.stack(rows).numpy()
            # In units of the ranges: some variables (a modulus at held volumes) hardly move an effector at all.
            ranges = np.array([space[k].high - space[k].low for k in exact])
            truth = np.stack(list(exact.values()), axis=1) * ranges
            predicted = jacobian[:, [space.names.index(k) for k in exact]] * ranges
            errors.append(np.linalg.norm(predicted - truth) / np.linalg.norm(truth))
        result[f"{variant}: bodies compared"] = len(errors)
        result[f"{variant}: relative error, median [%]"] = 100 * float(np.median(errors))
        result[f"{variant}: relative error, three quarters are below [%]"] = 100 * float(np.quantile(errors, 0.75))
    return result


def trajectories() -> dict[str, object]:
    """Closing trajectory of 25 goals on the thesis' designs: QP on the surrogate, its commands replayed on FEM.

    The goals are the FEM tip at 25 cable displacements from 0 to 20 mm. The error is that of the predicted tip
    positions, sqrt(sum |p_surrogate - p_FEM|^2) / sqrt(sum |p_FEM - p_rest|^2).
    """
    from softgym_envs.robots.registry import make_robot

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
        relative, worst = closing_error(robot, {key: value * unit for key, value in values.items()})
        result[f"{name}: error [%] (thesis {published} %)"] = relative
        result[f"{name}: worst [mm]"] = worst
    return result


def closing_error(robot: Robot, design: Mapping[str, float], weights: str | Path | None = None) -> tuple[float, float]:
    """Error of the predicted tip on the closing trajectory (see `trajectories`) [%], and its largest distance [mm].

    Args:
        robot: finger with one cable.
        design: its body.
        weights: name or folder of the surrogate's weights; default those that ship.
    """
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.backends.surrogate import SurrogateBackend
    from softgym_envs.control.inverse_qp import InverseQP

    fem, surrogate = FEMBackend(robot, design), SurrogateBackend(robot, design, weights=weights)
    rest = fem.state.effector[0]
    goals = [fem.step(np.array([d])).effector[0] for d in np.linspace(0.0, 0.02, 25)]
    fem.reset()
    controller = InverseQP.for_robot(robot)
    errors, moves = [], []
    for goal in goals:
        for _ in range(6):
            state = surrogate.state
            surrogate.step(controller.solve(state.condensed, goal, state.command, state.slack))
        truth = fem.step(surrogate.state.command).effector[0]
        errors.append(np.linalg.norm(truth - surrogate.state.effector[0]))
        moves.append(np.linalg.norm(truth - rest))
    return float(100.0 * np.linalg.norm(errors) / np.linalg.norm(moves)), float(1e3 * np.max(errors))


def slack_states() -> dict[str, object]:
    """Both backends under 200 random commands of the two-cable finger over random designs, slack cables included."""
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.backends.surrogate import SurrogateBackend
    from softgym_envs.robots.registry import make_robot

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

    The noise is the standard deviation of the third differences, which vanish for a smooth curve, over the mean.
    """
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.robots.registry import make_robot

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
