"""Controllers and couplings that work on condensed models, whether computed by finite elements or learned."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.control.contact_control import ContactControl as ContactControl
    from softgym_envs.control.contact_qp import ContactQP as ContactQP
    from softgym_envs.control.contact_qp import ForceGoal as ForceGoal
    from softgym_envs.control.coupling import HeldObject as HeldObject
    from softgym_envs.control.embedded import EmbeddedLoop as EmbeddedLoop
    from softgym_envs.control.embedded import PICorrection as PICorrection
    from softgym_envs.control.export.c import export_controller_c as export_controller_c
    from softgym_envs.control.finger_models import SurrogateFingers as SurrogateFingers
    from softgym_envs.control.fingers import CoupledFingers as CoupledFingers
    from softgym_envs.control.inverse_qp import InverseQP as InverseQP
    from softgym_envs.control.manipulation import Manipulation as Manipulation

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "contact_control": ["ContactControl"],
        "contact_qp": ["ContactQP", "ForceGoal"],
        "coupling": ["HeldObject"],
        "embedded": ["EmbeddedLoop", "PICorrection"],
        "export.c": ["export_controller_c"],
        "finger_models": ["SurrogateFingers"],
        "fingers": ["CoupledFingers"],
        "inverse_qp": ["InverseQP"],
        "manipulation": ["Manipulation"],
    },
)
