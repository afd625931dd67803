"""Where to evaluate the FEM: designs and actuation drawn together, states of one design solved as a path.

The condensed model is smooth in the *reached* actuator displacement, taut or pushed. Cables that hang slack reach
more than they are told; so commands are first solved as real cables, and part of the slack states are then solved
again with the slack cables pulled by up to ``margin``, as if they could push. The network thus knows the states on
the slack boundary and a little beyond, where a solver that looks for the boundary has to go.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.mechanics.statics import Equilibrium, Statics
from softgym_envs.robots.robot import Robot

__all__ = ["SamplingPlan", "sample_group"]


@dataclass(frozen=True)
class SamplingPlan:
    """A reproducible set of states, made of groups that share a design.

    Args:
        groups: number of designs.
        states: commanded states per design, beside the rest state.
        sequence: ``"halton"`` (scrambled; fills space) or ``"random"`` (for validation and test).
        seed: seed of the sequence.
        margin: how far beyond slack states are pushed [fraction of the actuator range].
    """

    groups: int
    states: int
    sequence: str = "halton"
    seed: int = 0
    margin: float = 0.1

    def __post_init__(self) -> None:
        if self.sequence not in ("halton", "random"):
            raise ValueError(f"sequence = {self.sequence!r} is unknown; allowed: 'halton', 'random'")
        if self.groups < 1 or self.states < 1:
            raise ValueError(f"groups = {self.groups} and states = {self.states} must be at least 1")

    def unit_points(self, dimension: int, first: int, count: int, stream: int) -> np.ndarray:
        """Points ``first .. first + count`` of the sequence in [0, 1], shape (count, dimension)."""
        if self.sequence == "halton":
            engine = qmc.Halton(dimension, scramble=True, rng=np.random.default_rng([self.seed, stream]))
            engine.fast_forward(first)
            return engine.random(count)
        return np.stack([np.random.default_rng([self.seed, stream, first + i]).random(dimension) for i in range(count)])


def learned_variables(robot: Robot) -> tuple[str, ...]:
    """Design variables a surrogate learns: all but the one that only scales efforts."""
    return tuple(name for name in robot.design_space.names if name != robot.stiffness_variable)


def sample_group(robot: Robot, plan: SamplingPlan, group: int) -> dict[str, np.ndarray] | None:
    """Solve all states of one design.

    Returns:
        Arrays with one row per solved state: ``design`` (all variables), ``displacement``, ``effort``, ``effector``,
        ``compliance`` (upper triangle of W, row by row), ``rest`` (1 for the rest state); None for a design that
        is infeasible or has no equilibrium at rest. States without an equilibrium are left out.
    """
    names = learned_variables(robot)
    space = robot.design_space
    unit = 2.0 * plan.unit_points(len(names), group, 1, 0)[0] - 1.0
    design = space.complete({name: float(space[name].from_unit(u)) for name, u in zip(names, unit, strict=True)})
    zero = np.zeros(len(robot.actuators))
    try:
        statics = Statics(robot.build(design))
        rows: list[Equilibrium] = [statics.solve(zero, "effort")]
    except (InfeasibleDesign, ConvergenceError):
        return None
    count = len(robot.actuators)
    fractions = plan.unit_points(count, group * plan.states, plan.states, 1)
    rng = np.random.default_rng([plan.seed, 2, group])
    for fraction in fractions:
        try:
            equilibrium = statics.solve(robot.lower + fraction * (robot.upper - robot.lower))
        except ConvergenceError:
            statics.restore(rows[0].x, rows[0].effort)
            continue
        if equilibrium.slack.any() and rng.random() < 0.5:
            push = rng.uniform(0.0, plan.margin, count) * (robot.upper - robot.lower) * equilibrium.slack
            kept = statics.unilateral
            statics.unilateral = np.zeros_like(kept)
            try:
                equilibrium = statics.solve(equilibrium.delta[:count] - push)
            except ConvergenceError:
                pass
            finally:
                statics.unilateral = kept
        rows.append(equilibrium)
    upper = np.triu_indices(len(rows[0].effort))
    return {
        "design": np.tile([design[name] for name in space.names], (len(rows), 1)),
        "displacement": np.stack([r.condensed.delta.a for r in rows]),
        "effort": np.stack([r.condensed.lambda_.a for r in rows]),
        "effector": np.stack([r.condensed.delta.e for r in rows]),
        "compliance": np.stack([r.condensed.compliance[upper] for r in rows]),
        "rest": np.arange(len(rows)) == 0,
    }
