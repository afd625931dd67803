"""Controllers: they take a condensed model and a goal, and never ask where the model came from."""

from softgym_envs.control.inverse_qp import InverseQP

__all__ = ["InverseQP"]
