"""Grasping: grippers of any number of fingers, contact-aided fingers, learned chains, inverse QP with contacts."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.grasping.control.contact_control import ContactControl as ContactControl
    from softgym_envs.extensions.grasping.control.contact_qp import ContactQP as ContactQP
    from softgym_envs.extensions.grasping.control.contact_qp import ForceGoal as ForceGoal
    from softgym_envs.extensions.grasping.grasps import GraspObject as GraspObject
    from softgym_envs.extensions.grasping.grasps import evaluate_grasp as evaluate_grasp

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "control.contact_control": ["ContactControl"],
        "control.contact_qp": ["ContactQP", "ForceGoal"],
        "grasps": ["GraspObject", "evaluate_grasp"],
    },
)
