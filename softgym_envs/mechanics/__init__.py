"""Mechanics of soft bodies: finite elements, actuators, solvers and the condensed model."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.mechanics.builder import ModelBuilder as ModelBuilder
    from softgym_envs.mechanics.condensation import CondensedModel as CondensedModel
    from softgym_envs.mechanics.constraints.bond import Bond as Bond
    from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints as EmbeddedPoints
    from softgym_envs.mechanics.constraints.point import Point as Point
    from softgym_envs.mechanics.contact.obstacles import Cylinder as Cylinder
    from softgym_envs.mechanics.contact.obstacles import MeshObstacle as MeshObstacle
    from softgym_envs.mechanics.contact.obstacles import Plane as Plane
    from softgym_envs.mechanics.contact.obstacles import Sphere as Sphere
    from softgym_envs.mechanics.io import read_mesh as read_mesh
    from softgym_envs.mechanics.mesh_checks import merge_nodes as merge_nodes
    from softgym_envs.mechanics.model import MechanicalModel as MechanicalModel
    from softgym_envs.mechanics.solvers.dynamics import Dynamics as Dynamics
    from softgym_envs.mechanics.solvers.statics import Statics as Statics

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "builder": ["ModelBuilder"],
        "condensation": ["CondensedModel"],
        "constraints.bond": ["Bond"],
        "constraints.embedding": ["EmbeddedPoints"],
        "constraints.point": ["Point"],
        "contact.obstacles": ["Cylinder", "MeshObstacle", "Plane", "Sphere"],
        "io": ["read_mesh"],
        "mesh_checks": ["merge_nodes"],
        "model": ["MechanicalModel"],
        "solvers.dynamics": ["Dynamics"],
        "solvers.statics": ["Statics"],
    },
)
