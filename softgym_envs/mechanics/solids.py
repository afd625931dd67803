"""Solid parts: a mesh with an element kind and elasticity becomes the data of an element block."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softgym_envs.errors import unknown_name
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.elements.averaged import AveragedTetrahedra
from softgym_envs.mechanics.elements.quadratic import EDGES, QuadraticTetrahedra, add_midside_nodes
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock, Tetrahedra, check_nodes
from softgym_envs.mechanics.mesh_checks import check_mesh
from softgym_envs.quantities import check_quantity, finite_number, numbers

SOLIDS: dict[str, type[SolidBlock]] = {
    kind.element: kind for kind in (Tetrahedra, AveragedTetrahedra, QuadraticTetrahedra)
}
"""Solid elements by name."""

DEFAULT_ELEMENT = "quadratic"
"""Element of a mesh of one's own, unless another one is asked for: right in thin walls and near a ratio of 0.5."""

PerElement = float | np.ndarray | Mapping[str, float] | Callable[[np.ndarray], np.ndarray]
"""A value for all elements, one for each (m,), one for each region by name, or a function of the centroids (m, 3)."""

Fixed = np.ndarray | list[int] | Callable[[np.ndarray], np.ndarray]
"""Clamped nodes: indices, a mask (n,), a mask (n, 3) by axis, or a function of the nodes [m] (n, 3) to one of them."""


@dataclass(frozen=True)
class SolidPart:
    """A solid body, ready to become an element block ``kind(nodes, connectivity, **options)``.

    Attributes:
        nodes: [m], shape (n, 3), midside nodes included.
        connectivity: node indices of the elements, shape (m, 4) or (m, 10).
        fixed: components of nodes that are clamped, mask of shape (n, 3).
        kind: class of the element block.
        options: its material, young_modulus, poisson_ratio and density.
    """

    nodes: np.ndarray
    connectivity: np.ndarray
    fixed: np.ndarray
    kind: type[SolidBlock]
    options: dict[str, Any]


def solid_part(
    nodes: np.ndarray,
    tetrahedra: np.ndarray,
    *,
    fixed: Fixed,
    element: str = DEFAULT_ELEMENT,
    young_modulus: PerElement = 3.0e6,
    poisson_ratio: PerElement = 0.3,
    total_mass: float | None = None,
    regions: Mapping[str, np.ndarray] | None = None,
    check: bool = True,
    **options: Any,
) -> SolidPart:
    """Prepare a solid body; see `MechanicalModel.from_mesh` for the arguments."""
    if element not in SOLIDS:
        raise ValueError(unknown_name("element", element, SOLIDS))
    nodes, tetrahedra = check_nodes(nodes), np.asarray(tetrahedra)
    check_size(nodes, "for nodes in millimetres pass 1e-3 * nodes")
    if check:
        check_mesh(nodes, tetrahedra[:, :4] if tetrahedra.ndim == 2 else tetrahedra)
    mask = fixed_mask(fixed(nodes) if callable(fixed) else fixed, len(nodes))
    if element == "quadratic" and tetrahedra.ndim == 2 and tetrahedra.shape[1] == 4:
        count = len(nodes)
        nodes, tetrahedra = add_midside_nodes(nodes, tetrahedra)
        ends = np.zeros((len(nodes) - count, 2), dtype=np.int64)
        for slot, edge in enumerate(EDGES):
            ends[tetrahedra[:, 4 + slot] - count] = tetrahedra[:, edge]
        mask = np.vstack([mask, mask[ends].all(axis=1)])
    kind = SOLIDS[element]
    for name, value in (("young_modulus", young_modulus), ("poisson_ratio", poisson_ratio)):
        options[name] = _element_values(name, value, nodes, tetrahedra, regions or {})
    if total_mass is not None:
        if not finite_number(total_mass, "total_mass", "kg") > 0.0:
            raise ValueError(f"total_mass = {total_mass} kg must be positive and finite")
        density = total_mass / kind(nodes, tetrahedra).volume  # type: ignore[call-arg]
        check_quantity(
            "density", density, f"total_mass = {total_mass:g} kg: density", factors={"total_mass in g": 1e-3}
        )
        options["density"] = density
    return SolidPart(nodes, tetrahedra, mask, kind, options)


def fixed_mask(fixed: np.ndarray | Sequence[int], count: int) -> np.ndarray:
    """Return which components of nodes are clamped, mask (count, 3).

    Args:
        fixed: numbers of nodes, a mask (count,), or a mask (count, 3) by axis.
        count: number of nodes.

    Raises:
        ValueError: for anything else.
    """
    chosen = np.asarray(fixed)
    if chosen.size == 0:
        chosen = np.zeros(0, dtype=np.int64)
    is_mask = chosen.dtype == bool and chosen.shape in ((count,), (count, 3))
    if not is_mask and not (chosen.ndim == 1 and are_rows(chosen, count)):
        raise ValueError(
            f"'fixed' must be numbers of nodes from 0 to {count - 1}, or a mask ({count},) or ({count}, 3), got "
            f"{described(chosen)}"
        )
    mask = np.zeros((count, 3), dtype=bool)
    mask[chosen] = True
    return mask


def described(numbers: np.ndarray) -> str:
    """Return what an array holds, for messages: which integers, or its shape and type."""
    if numbers.dtype.kind in "iu" and numbers.size:
        return f"integers of shape {numbers.shape} from {numbers.min()} to {numbers.max()}"
    return f"an array of shape {numbers.shape} of {numbers.dtype}"


def are_rows(numbers: np.ndarray, count: int) -> bool:
    """Return whether an array holds integers from 0 to ``count - 1``, and not a mask."""
    return numbers.dtype.kind in "iu" and bool(((numbers >= 0) & (numbers < count)).all())


def check_size(nodes: np.ndarray, hint: str, *, high: float | None = None, example: str = "") -> None:
    """Reject a body whose largest side [m] is not plausible; ``high`` and ``example`` are those of `check_quantity`.

    Raises:
        ValueError: with a hint on how to correct the unit.
    """
    sides = np.ptp(nodes, axis=0) if len(nodes) else np.zeros(3)
    spans = " x ".join(f"{side:.3g}" for side in sides)
    check_quantity("size", sides.max(), f"the body measures {spans} m; its size", high=high, example=example, hint=hint)


def check_modulus(young_modulus: ArrayLike) -> None:
    """Reject Young's moduli [Pa] that are not plausible; those that are not positive are left to the elements.

    Only parts of a robot, a mesh of one material and `SolidBlock.set_elasticity` are checked: `ModelBuilder` takes any,
    for models in units without dimensions.

    Raises:
        ValueError: with a hint on how to correct the unit.
    """
    values = np.ravel(np.asarray(young_modulus, dtype=float))
    check_quantity("modulus", values[values > 0.0], "young_modulus")


def check_distance(points: Any, nodes: np.ndarray, name: str, sizes: float) -> None:
    """Reject points that lie more than ``sizes`` body sizes outside the bounding box of a body.

    Args:
        points: [m], shape (p, 3) or (3,).
        nodes: of the body [m], shape (n, 3).
        name: what the points are, for the message.
        sizes: limit in units of the diagonal of the box.

    Raises:
        ValueError: with the point that lies farthest outside.
    """
    numbers(points, name, "m")
    points = np.atleast_2d(np.asarray(points, dtype=float))
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name} must have coordinates of shape (p, 3), got {points.shape}")
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    size = float(np.linalg.norm(high - low))
    away = np.linalg.norm(points - np.clip(points, low, high), axis=1)
    if away.max(initial=0.0) > sizes * size:
        worst = int(np.argmax(away))
        raise ValueError(
            f"{name} at {points[worst].tolist()} m lies {away[worst]:.3g} m outside the body, "
            f"which is {size:.3g} m long; did you mean metres?"
        )


def check_guides(guides: EmbeddedPoints, nodes: np.ndarray, name: str) -> None:
    """Reject points that are extrapolated from an element farther away than it is long.

    Args:
        guides: points in elements, with their corners.
        nodes: of the body [m], shape (n, 3).
        name: what the points are, for the message.

    Raises:
        ValueError: with the point that lies farthest outside.
    """
    corners = nodes[guides.node_ids[:, :4]]
    edges = np.linalg.norm(corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]], axis=2).max(axis=1)
    barycentric = np.linalg.solve(
        np.concatenate([np.ones((len(corners), 1, 4)), np.swapaxes(corners, 1, 2)], axis=1),
        np.column_stack([np.ones(len(corners)), guides.points])[..., None],
    )[..., 0]
    inside = barycentric.clip(min=0.0)
    nearest = np.einsum("pk,pkd->pd", inside / inside.sum(axis=1, keepdims=True), corners)
    away = np.linalg.norm(guides.points - nearest, axis=1)
    worst = int(np.argmax(away - edges))
    if away[worst] > edges[worst]:
        raise ValueError(
            f"{name} at {np.round(guides.points[worst], 6).tolist()} m lies {away[worst]:.3g} m outside the body; pass "
            "'hint', the element that carries it, if that is meant"
        )


def _element_values(
    name: str, values: PerElement, nodes: np.ndarray, tetrahedra: np.ndarray, regions: Mapping[str, np.ndarray]
) -> float | np.ndarray:
    """Return one value for all elements, or an array with one for each."""
    count = len(tetrahedra)
    if isinstance(values, Mapping):
        out = np.full(count, np.nan)
        for region, value in values.items():
            if region not in regions:
                raise ValueError(f"{name}: {unknown_name('region', region, regions)}")
            if (twice := np.isfinite(out[regions[region]]) & (out[regions[region]] != value)).any():
                raise ValueError(
                    f"{name}: {np.count_nonzero(twice)} of {count} elements are in region '{region}' and in one with "
                    "another value; regions with different values must not overlap"
                )
            out[regions[region]] = value
        missing = np.flatnonzero(np.isnan(out))
        if len(missing):
            without = [
                region for region, ids in regions.items() if region not in values and np.isin(missing, ids).any()
            ]
            where = f", in the regions {', '.join(without)}" if without else ""
            raise ValueError(f"{name} gives no value for {len(missing)} of {count} elements{where}")
        return out
    if callable(values):
        values = np.asarray(values(nodes[tetrahedra[:, :4]].mean(axis=1)), dtype=float)
    numbers(values, name)
    array = np.asarray(values, dtype=float)
    if array.ndim and array.shape != (count,):
        raise ValueError(f"{name} must be one number, or one for each of the {count} elements, got shape {array.shape}")
    return array if array.ndim else float(array)


def nodes_in_box(nodes: np.ndarray, box: Sequence[float]) -> np.ndarray:
    """Mask (n,) of the nodes inside (xmin, xmax, ymin, ymax, zmin, zmax) [m]."""
    limits = np.asarray(box, dtype=float)
    if limits.shape != (6,):
        raise ValueError(f"fixed_box must be xmin, xmax, ymin, ymax, zmin, zmax, got {box!r}")
    low, high = limits.reshape(3, 2).T
    inside = np.all((nodes >= low) & (nodes <= high), axis=1)
    if not inside.any():
        spans = ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(nodes.min(axis=0), nodes.max(axis=0), strict=True))
        raise ValueError(
            f"no node is fixed: none lies in fixed_box {limits.tolist()} m; the body spans {spans} m along x, y and z"
        )
    return inside
