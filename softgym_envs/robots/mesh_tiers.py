"""How finely a robot is meshed: three meshes by name.

* ``published``: that of the published scene, for comparison with its values. Coarse, of linear elements, with cables
  that act on single points.
* ``accurate``: the effector of a command lies within about 2 % of the converged one.
* ``reference``: about half as large elements, for estimates of the error of ``accurate``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from softgym_envs.errors import unknown_name

T = TypeVar("T")

UNIFORM: dict[str, object] = {"mesh": "published", "element": "linear", "fillet": 0.0, "guide_radius": 0.0}
"""Options of the mesh that are not part of a robot's key: those of the published scenes."""

FOLLOWING = ("feature_size", "guide_radius", "guide_size")
"""Parts of a mesh that are in a robot's key, though they follow from its name: a later version may change them."""


@dataclass(frozen=True)
class MeshTier:
    """Mesh of a solid robot.

    Attributes:
        size: edge length of the elements [m].
        element: name of the solid element, see `softgym_envs.mechanics.solids.SOLIDS`.
        feature_size: edge length where the body bends most [m]; None for elements of one size.
        fillet: radius of re-entrant edges [m]; 0 for sharp edges.
        guide_radius: radius of the part of the body on which a cable's guide, or another point that carries a load,
            acts [m]; 0 for a single point.
        guide_size: edge length in those parts of the body [m]; None where it is that of the elements around them.
    """

    size: float
    element: str = "linear"
    feature_size: float | None = None
    fillet: float = 0.0
    guide_radius: float = 0.0
    guide_size: float | None = None

    def changed(
        self,
        robot: str,
        *,
        size: float | None,
        element: str | None,
        fillet: float | None,
        guide_radius: float | None,
        largest: float = np.inf,
    ) -> MeshTier:
        """Return a tier in which the options that are given replace those of this one.

        With a ``size``, all sizes change in the same proportion. No length may exceed ``largest`` [m].

        Raises:
            ValueError: naming the robot and the option that is not allowed.
        """
        size = self.size if size is None else size
        fillet = self.fillet if fillet is None else fillet
        guide_radius = self.guide_radius if guide_radius is None else guide_radius
        element = self.element if element is None else element
        if not (isinstance(size, int | float) and 0.0 < size < np.inf):
            raise ValueError(f"robot '{robot}': mesh_size = {size!r} m must be positive and finite")
        for name, length in (("fillet", fillet), ("guide_radius", guide_radius)):
            if not (isinstance(length, int | float) and 0.0 <= length < np.inf):
                raise ValueError(f"robot '{robot}': {name} = {length!r} m must be finite and not negative")
        for name, length in (("mesh_size", size), ("fillet", fillet), ("guide_radius", guide_radius)):
            if length > largest:
                raise ValueError(
                    f"robot '{robot}': {name} = {length:g} m is larger than the robot, whose size is {largest:g} m; "
                    "did you mean metres?"
                )
        if element != self.element:
            from softgym_envs.mechanics.solids import SOLIDS

            if element not in SOLIDS:
                raise ValueError(unknown_name("element", element, SOLIDS))
        feature, guide = (None if s is None else s * size / self.size for s in (self.feature_size, self.guide_size))
        return replace(
            self,
            size=float(size),
            element=element,
            feature_size=feature,
            fillet=float(fillet),
            guide_radius=float(guide_radius),
            guide_size=guide,
        )


def choose_mesh(meshes: Mapping[str, T], mesh: Any) -> T:
    """Return one of a robot's meshes by name.

    Raises:
        ValueError: for an unknown name.
    """
    if mesh not in meshes:
        raise ValueError(unknown_name("mesh", mesh, meshes))
    return meshes[mesh]
