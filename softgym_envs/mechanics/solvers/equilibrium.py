"""What static solvers take and return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.contact.contact import ContactMemory, Contacts


@dataclass(frozen=True)
class Equilibrium:
    """A solved state.

    Attributes:
        x: node positions [m], shape (n, 3).
        condensed: the condensed model at the state; bonds are eliminated from it.
        delta: constraint values of all rows, bonds last, shape (size,).
        effort: efforts of all rows, bonds last, shape (size,).
        slack: per actuator row, True where a unilateral actuator hangs slack.
        stable: whether the tangent is positive definite. Then the state is stable however its actuators are driven;
            otherwise it can still be stable while they are driven in displacement.
        iterations: Newton iterations spent, over all load increments.
        increments: load increments used.
        contacts: where the body touches; None if it cannot.
        memory: what friction remembers, for `Statics.restore`; None without contact.
    """

    x: np.ndarray
    condensed: CondensedModel
    delta: np.ndarray
    effort: np.ndarray
    slack: np.ndarray
    stable: bool
    iterations: int
    increments: int
    contacts: Contacts | None = None
    memory: ContactMemory | None = None


class AppliedLoads(TypedDict, total=False):
    """Loads besides those of the actuators: keyword arguments of `Statics.solve`, which describes them."""

    effector_force: Sequence[float] | np.ndarray | None
    contact: Sequence[float] | np.ndarray | None
    contact_mode: str
