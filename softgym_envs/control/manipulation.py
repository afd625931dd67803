"""Manipulation of a rigid object by soft fingers whose condensed models are coupled (thesis Algorithm 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softgym_envs.control.coupling import Coupled, HeldObject, couple
from softgym_envs.control.inverse_qp import InverseQP
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
    """Brings an object that is held at contact points to a goal.

    Each call ties the condensed models of the parts to the object, ``X = A effort + B`` (eq. 4.8-4.10), asks the
    inverse QP for actuator efforts, and evaluates contact forces and pose at them. The thesis takes the force on the
    object from the last step; here the object is in equilibrium under its load at every step, so that force is
    known: zero or the weight for a gripper, the spring for a button. The last contact forces enter through the models,
    which are taken under them, and through the torque they exert on a turned object.

    Between calls the parts are brought to the plan: each in its commands and under its contact forces (or with its
    contact points at ``body.contacts``). Where parts bend, tied points then part by the second order of the step; the
    next call closes that gap, as Newton's method does.

    Args:
        controller: inverse QP over the actuators of all parts; its ``goal_weights`` choose the degrees of freedom of
            the object that matter. A radian counts as a metre where they do not say otherwise.
        body: the object at its first pose; its flags ``free`` tell which way a guided one moves, e.g. a button.
        tolerance: see `couple`.

    Attributes:
        body: the object at its present pose, as last predicted or measured.
        contact_forces: last forces of the object on the parts [N], shape (k, 3); zero at the start.
    """

    def __init__(self, controller: InverseQP, body: HeldObject, *, tolerance: float = 1e-10) -> None:
        self.controller = controller
        self.tolerance = tolerance
        self.reset(body)

    def reset(self, body: HeldObject) -> None:
        """Start again with an object that is not held yet."""
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
            models: condensed models of the parts at their present states, roles ``a`` and ``c``.
            goal: position of the object's centre [m], shape (3,).
            command: present command of the actuators of all parts, shape (n_a,).
            slack: actuators that hang slack, shape (n_a,).
            rotation: desired orientation, shape (3, 3), or None to leave it to itself.
            body: the measured object, where there is a sensor; default the predicted one.
            load: new force and torque on the object [N, N m], shape (6,). Soft parts give way to it at once: bring a
                large one on over several calls, as their actuators need time to answer.

        Raises:
            ValueError: for malformed or non-finite input, or points that do not hold the object.
            ConvergenceError: if the QP finds no step; the state is kept.
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
