"""Manipulation of a rigid object by soft fingers whose condensed models are coupled (thesis, algorithm 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.extensions.grasping.control.coupling import Coupled, HeldObject, couple
from softgym_envs.mechanics.condensation import CondensedModel


@dataclass(frozen=True)
class Plan:
    """One step of the object.

    Attributes:
        command: actuator displacements or efforts to apply, part by part, shape (n_a,).
        effort: actuator efforts that the model predicts, shape (n_a,).
        contact_forces: forces of the object on the parts [N], shape (k, 3).
        body: the object at the pose that the model predicts.
        coupled: the model that the step was planned on.
    """

    command: np.ndarray
    effort: np.ndarray
    contact_forces: np.ndarray
    body: HeldObject
    coupled: Coupled


class Manipulation:
    """Controller that moves an object held at contact points to a goal.

    Each call ties the condensed models of the parts to the object, ``X = A effort + B`` (eq. 4.8-4.10), asks the
    inverse QP for actuator efforts, and evaluates the contact forces and the pose for these efforts. The thesis takes
    the force on the object from the last step. Here the object is in equilibrium under its load at every step, so this
    force is known: zero or the weight for a gripper, the spring for a button. The last contact forces enter through the
    models, which are evaluated under them, and through the torque that they exert on a rotating object.

    Between calls, apply the plan to the parts: each gets its commands and its contact forces (or its contact points are
    driven to ``body.contacts``). As parts bend, tied points then separate by a distance of second order in the step;
    the next call closes this gap, as Newton's method does.

    Args:
        controller: inverse QP over the actuators of all parts; its ``goal_weights`` choose the degrees of freedom of
            the object that count. By default, a radian counts as much as a metre.
        body: the object at its first pose; for a guided one, such as a button, the flags ``free`` select directions.
        tolerance: see `couple`.

    Attributes:
        body: the object at its current pose, predicted or measured.
        contact_forces: last forces of the object on the parts [N], shape (k, 3); zero at the start.
    """

    def __init__(self, controller: InverseQP, body: HeldObject, *, tolerance: float = 1e-10) -> None:
        self.controller = controller
        self.tolerance = tolerance
        self.reset(body)

    def reset(self, body: HeldObject) -> None:
        """Start again with an object on which no contact forces act yet."""
        self.body = body
        self.contact_forces = np.zeros_like(body.points)

    def solve(
        self,
        models: Sequence[CondensedModel],
        goal: np.ndarray,
        command: np.ndarray,
        slack: np.ndarray | None = None,
        *,
        rotation: np.ndarray | None = None,
        body: HeldObject | None = None,
        load: np.ndarray | None = None,
    ) -> Plan:
        """Plan the next step.

        Args:
            models: condensed models of the parts at their current states, roles ``a`` and ``c``.
            goal: position of the object's centre [m], shape (3,).
            command: current command of the actuators of all parts, shape (n_a,).
            slack: actuators that are slack, shape (n_a,).
            rotation: desired orientation, shape (3, 3), or None to leave it free.
            body: the measured object, if there is a sensor; by default the predicted one.
            load: new force and torque on the object [N, N m], shape (6,). Soft parts yield to it at once, while
                actuators need time to respond: apply a large load over several calls.

        Raises:
            ValueError: for malformed or non-finite input, or points that do not hold the object.
            ConvergenceError: if the QP finds no step; the state is unchanged.
        """
        held = self.body if body is None else body
        if load is not None:
            held = replace(held, load=load)
        coupled = couple(models, body=held, orientation=rotation is not None, tolerance=self.tolerance)
        wanted = np.asarray(goal, dtype=float).ravel()
        if rotation is not None:
            from scipy.spatial.transform import Rotation

            turn = Rotation.from_matrix(np.asarray(rotation, dtype=float) @ held.rotation.T)
            wanted = np.append(wanted, turn.as_rotvec())
        command = self.controller.solve(coupled.condensed, wanted, command, slack)
        effort = self.controller.effort
        forces = [every[model.slices["c"]] for every, model in zip(coupled.efforts(effort), models, strict=True)]
        self.body = held.moved(coupled.motion(effort))
        self.contact_forces = np.concatenate(forces).reshape(-1, 3)
        return Plan(command, effort, self.contact_forces, self.body, coupled)
