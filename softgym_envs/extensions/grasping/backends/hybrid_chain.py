"""The hybrid backends of learned chains, alone or as a hand: the chain where it is trusted, finite elements elsewhere.

Friction depends on the path, so finite elements follow the commands of the episode before they answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.hybrid_path import PathHybridBackend
from softgym_envs.designs import Design
from softgym_envs.extensions.grasping.backends.chain import ChainBackend
from softgym_envs.extensions.grasping.backends.chain_hand import ChainHandBackend
from softgym_envs.extensions.grasping.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.extensions.grasping.robots.grasping_hands import ContactAidedGripper


class HybridChainBackend(PathHybridBackend):
    """A learned chain where it is trusted, elsewhere finite elements.

    The chain is not trusted for bodies outside its training, and where the finger would touch itself. Finite elements
    then follow all commands of the episode that they have not seen yet. The chain does not learn from them.

    Args:
        robot: a contact-aided finger, with anything to touch.
        design: first design; missing variables take their baseline.
        weights: folder of weights; default the shipped ones.

    Attributes:
        calls: states requested by `step` and `probe`.
        fem_calls: solutions of finite elements, including those of bodies at rest.
        learned: backend of the learned chain.

    Raises:
        WeightsError: if the weights are damaged, or belong to a finger with another mesh or material.
        InfeasibleDesign: if the body cannot exist.
    """

    def __init__(
        self,
        robot: ContactAidedFinger,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
    ) -> None:
        self._start(robot, ChainBackend(robot, design, weights))

    def _finite_elements(self, design: Design) -> FEMBackend:
        return FEMBackend(self.robot, design)


class HybridHandBackend(HybridChainBackend):
    """A hand of two learned chains with a free box where it is trusted, elsewhere finite elements in motion.

    As for a single finger. A step of finite elements is one implicit time step with the damping of `FEMBackend`.

    Args:
        robot: a hand of two contact-aided fingers.
        design: first design; missing variables take their baseline.
        weights: folder of weights of its finger; default the shipped ones.
        control_step: duration of one `step` [s].

    Raises:
        WeightsError: if the weights are damaged, or belong to a finger with another mesh or material.
        InfeasibleDesign: if the body cannot exist.
        ValueError: for a hand that cannot be learned, see `ChainHandBackend`.
    """

    moving = True

    def __init__(
        self,
        robot: ContactAidedGripper,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        control_step: float = 0.05,
    ) -> None:
        self.control_step = control_step
        self._start(robot, ChainHandBackend(robot, design, weights, control_step))

    def _finite_elements(self, design: Design) -> FEMBackend:
        return FEMBackend(
            self.robot, design, dynamics=True, control_step=self.control_step, time_step=self.control_step
        )
