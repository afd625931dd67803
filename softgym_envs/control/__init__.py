"""Controllers: they take a condensed model and a goal, and never ask where the model came from."""

from softgym_envs.control.coupling import Coupled, HeldObject, couple, rotate, tie_points
from softgym_envs.control.embedded import EmbeddedLoop, PICorrection, follow
from softgym_envs.control.fingers import CoupledFingers, FEMFingers, FingersState, SurrogateFingers
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.control.manipulation import Manipulation, Plan

__all__ = [
    "Coupled",
    "CoupledFingers",
    "EmbeddedLoop",
    "FEMFingers",
    "FingersState",
    "InverseQP",
    "Manipulation",
    "PICorrection",
    "Plan",
    "SurrogateFingers",
    "HeldObject",
    "couple",
    "follow",
    "rotate",
    "tie_points",
]
