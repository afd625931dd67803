"""Grasping: contact-aided fingers and hands, their tasks, learned chains, inverse QP with contacts, coupled fingers."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.grasping.control.contact_control import ContactControl as ContactControl
    from softgym_envs.extensions.grasping.control.contact_qp import ContactQP as ContactQP
    from softgym_envs.extensions.grasping.control.contact_qp import ForceGoal as ForceGoal
    from softgym_envs.extensions.grasping.control.finger_models import SurrogateFingers as SurrogateFingers
    from softgym_envs.extensions.grasping.control.fingers import CoupledFingers as CoupledFingers
    from softgym_envs.extensions.grasping.control.manipulation import Manipulation as Manipulation
    from softgym_envs.extensions.grasping.grasps import GraspObject as GraspObject
    from softgym_envs.extensions.grasping.grasps import evaluate_grasp as evaluate_grasp

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "control.contact_control": ["ContactControl"],
        "control.contact_qp": ["ContactQP", "ForceGoal"],
        "control.finger_models": ["SurrogateFingers"],
        "control.fingers": ["CoupledFingers"],
        "control.manipulation": ["Manipulation"],
        "grasps": ["GraspObject", "evaluate_grasp"],
    },
)
