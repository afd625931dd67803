"""A gripper whose number of fingers, their spacing and their angle are part of the design."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softgym_envs.designs import Design, DesignVariable
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.elements import Port, curve_skin
from softgym_envs.extensions.beams.pose import Pose
from softgym_envs.extensions.grasping.held_fingers import CABLES, HeldFingers, IdleCables, SolvedFingers
from softgym_envs.extensions.grasping.robots.contact_finger import ContactFinger
from softgym_envs.extensions.grasping.robots.grippers import TURNED, Placements, ThreeFingerGripper
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.geometry.finger_shape import THICKNESS

ARRANGEMENTS = {"1+1": (1, 1), "1+2": (1, 2), "2+2": (2, 2), "2+3": (2, 3)}
"""Numbers of fingers that push along +y and along -y."""

MOST = 5
EDGE = 5.0e-3
"""By how much the cube reaches beyond the middle of the outermost finger [m]."""
IDLE_STIFFNESS = 1000.0
"""Of the spring that a cable pulls whose finger is missing [N/m]: its range takes 20 N, as in a finger."""


PATH_STEP, PATH_TOLERANCE, PATH_PATIENCE = 8.0e-3, 1.0e-4, 2
"""Of paths on which states of fingers lie: steps of the cables [m], how close to the equilibria they end [m], and how
often in a step a finger may have no equilibrium until the command is given up."""

DOWNWARDS = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Axes of a finger as columns, the first one along it."""


class ComposedGripper(ThreeFingerGripper):
    """Two to five fingers on two sides of a cube; the baseline is the published gripper of three.

    Fingers of one side stand in a row, ``spacing`` apart, and each is turned against the next by ``angle``, so that all
    of them face the middle. There are ten cables in any body: those of fingers that it does not have pull a spring each
    and move nothing, so that one policy can drive all bodies.

    Args:
        **options: options of `FingerRobot`.
    """

    name = "composed_gripper"
    goal_tolerance = 5e-4  # as of the gripper of two fingers, which is as soft
    placements = ((np.eye(3), (0.0, 0.0, 0.0)),) * MOST
    backends = {
        "surrogate": "softgym_envs.extensions.grasping.backends.fingers:FingersBackend",
        "hybrid": "softgym_envs.extensions.grasping.backends.fingers:FingersHybridBackend",
    }

    def variables(self) -> tuple[DesignVariable, ...]:
        """Return the variables of the finger, and where the fingers are."""
        count = float(len(ARRANGEMENTS))
        kinds = ", ".join(ARRANGEMENTS)
        return (
            *super().variables(),
            DesignVariable("spacing", 0.045, 0.080, 0.060, "m", "distance of neighbouring fingers of one side"),
            DesignVariable(
                "angle", 0.0, 0.6, 0.0, "rad", "by which neighbouring fingers of one side are turned inwards"
            ),
            DesignVariable(
                "fingers",
                0.0,
                count,
                1.5,
                "1",
                f"numbers of fingers of both sides: {kinds}",
                choices=tuple(ARRANGEMENTS),
            ),
        )

    def _sides(self, design: Mapping[str, float]) -> tuple[int, int]:
        return ARRANGEMENTS[self.design_space["fingers"].choice(design["fingers"])]

    def arrangement(self, design: Mapping[str, float]) -> Placements:
        middle = np.append(self.object_rest(design)[:2], 0.0)
        found = []
        for side, count in enumerate(self._sides(design)):
            for place in (1 - 2 * side) * (np.arange(count) - 0.5 * (count - 1)):
                turn = _about_z(design["angle"] * place)
                # A finger is turned about its contact points, which stay in the row.
                height = np.array([0.0, design["height"], 0.0])
                shift = np.array([design["spacing"] * place, 0.0, 0.0]) - middle + height - turn @ height
                whole = TURNED if side else np.eye(3)
                found.append((whole @ turn, tuple(whole @ shift + middle)))
        return tuple(found)

    def one_part(self) -> ContactFinger:
        """Return the finger of which the gripper consists, as the robot that is learned."""
        return ContactFinger(**self._options)

    def part_states(self, design: Design, commands: np.ndarray) -> tuple[list[list[Equilibrium]], int]:
        """Return states of the fingers of a body on the way of the gripper from command to command.

        They are finite elements, and the states those in which Newton's method of the gripper asks for their forces: on
        the path of equilibria and beside it, where the gripper of learned fingers will ask, too.

        Args:
            design: of the gripper.
            commands: shortenings of the cables [m], shape (n, 10), in the order of the path.

        Returns:
            The states of each finger from rest on, and the number of commands without an equilibrium.

        Raises:
            InfeasibleDesign: for a body that cannot exist.
            ConvergenceError: if the body has no equilibrium at rest.
        """
        fingers = SolvedFingers(self.one_part(), design, tolerance=1e-9)
        model = self.of_parts({"finger": lambda design, gravity: {"energy": fingers}}).build(design)
        statics = Statics(model, tolerance=PATH_TOLERANCE, max_iterations=10, max_halvings=2)
        start, lost = np.zeros(len(self.actuators)), 0
        statics.solve(start)
        for command in commands:
            steps = int(np.ceil(np.abs(command - start).max() / PATH_STEP))
            try:
                for target in np.linspace(start, command, steps + 1)[1:]:
                    fingers.patience = PATH_PATIENCE
                    statics.solve(target)
                    start = target
            except ConvergenceError:
                lost += 1
        return fingers.found, lost

    def add_object(self, assembly: ModelBuilder, design: Mapping[str, float]) -> int:
        frame = super().add_object(assembly, design)
        assert frame is not None
        first, held = assembly.size, (False, False, True)
        if self.parts:
            own = [held] * len(self._arranged)
            part = self.parts["finger"](design, np.array(self.gravity))
            assembly.add_element(HeldFingers, (frame,), own=own, placements=self._arranged, **part)
        if missing := MOST - len(self._arranged):
            assembly.add_element(IdleCables, (), own=[held] * missing, stiffness=IDLE_STIFFNESS)
        self._cable_rows = range(first, assembly.size)
        return frame

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Place the fingers, or what is learned of them, and tie them to the object."""
        if not self.parts:
            return super().assemble(design)
        self._arranged = self.arrangement(design)
        builder = ModelBuilder(gravity=self.gravity)
        frame = self.add_object(builder, design)
        flanges = [builder.add_frame(shift, turn, fixed=True, fixed_spin=True) for turn, shift in self._arranged]
        model = builder.build()
        self.attach_object(model, design, frame)
        half = 0.5 * design["height"]
        outline = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * [0.5e-3 * THICKNESS, half]
        for flange, (turn, shift) in zip(flanges, self._arranged, strict=True):
            ends = (np.array([0.0, half, z]) for z in (0.0, -3.0 * design["length"]))
            near, far = (
                Port(f, turn @ end + shift, turn @ DOWNWARDS) for f, end in zip((flange, frame), ends, strict=True)
            )
            model.skins.append(curve_skin(near, far, 3.0 * design["length"], outline, model.nodes))
        return model

    def attach_object(self, model: MechanicalModel, design: Mapping[str, float], frame: int | None) -> None:
        """Add the cables that have rows of their own, and tie the contact points to the cube, which is the effector."""
        for row in self._cable_rows:
            for component in range(CABLES):
                actuator = self.actuators[len(model.constraints["a"])]
                cable = Pose(actuator.name, row, component, model.nodes)
                cable.unilateral = actuator.unilateral
                model.add("a", cable)
        beside = max(count - 1 for count in self._sides(design)) * 0.5 * design["spacing"]
        self.half_extents = (max(beside + EDGE, self.half_extents[1]), *self.half_extents[1:])
        super().attach_object(model, design, frame)

    def tie_contacts(self, model: MechanicalModel, frame: int) -> None:
        if not self.parts:  # learned fingers hold the frame itself
            super().tie_contacts(model, frame)


def _about_z(angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) about z by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
