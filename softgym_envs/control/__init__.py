"""Controllers that work on condensed models, whether computed by finite elements or learned."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.control.inverse_qp import InverseQP as InverseQP
    from softgym_envs.control.pi_correction import PICorrection as PICorrection

__getattr__, __dir__, __all__ = lazy_exports(__name__, {"inverse_qp": ["InverseQP"], "pi_correction": ["PICorrection"]})
