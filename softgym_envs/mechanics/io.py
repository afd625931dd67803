"""Reading meshes from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softgym_envs.errors import DataError


def read_mesh(path: str | Path, *, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Read nodes [m] (n, 3) and tetrahedra (m, 4) from any file meshio reads.

    Args:
        path: mesh file.
        scale: factor to metres, 1e-3 for a file in millimetres.

    Raises:
        DataError: if the file is missing, unreadable or holds no tetrahedra.
    """
    import meshio

    path = Path(path)
    if not path.is_file():
        raise DataError(f"mesh file '{path}' does not exist")
    suffix = path.suffix.lower()
    file_format = None
    if suffix == ".off":
        raise DataError(f"mesh file '{path}' holds no tetrahedra: the format .off is for surfaces")
    if suffix == ".msh":
        # Two programs use this suffix. meshio tries Ansys first, and looks for the end of a cut-off section for ever.
        content = path.read_bytes()
        file_format = "gmsh" if content.lstrip().startswith(b"$") else "ansys"
        if file_format == "ansys" and not content.rstrip().endswith(b")"):
            raise DataError(f"mesh file '{path}' is neither a Gmsh mesh nor a whole Ansys mesh")
    try:
        mesh = meshio.read(path, file_format=file_format)
    except (Exception, SystemExit) as error:  # meshio leaves with SystemExit on some malformed files
        raise DataError(f"mesh file '{path}' cannot be read: {error}") from error
    blocks = [block.data for block in mesh.cells if block.type == "tetra"]
    if not blocks:
        found = sorted({block.type for block in mesh.cells})
        raise DataError(f"mesh file '{path}' holds no tetrahedra (cell type 'tetra'); found {found}")
    tetrahedra = np.concatenate(blocks)
    if tetrahedra.size and not 0 <= tetrahedra.min() <= tetrahedra.max() < len(mesh.points):
        raise DataError(
            f"mesh file '{path}': tetrahedra refer to nodes {tetrahedra.min()}..{tetrahedra.max()}, "
            f"it has {len(mesh.points)}"
        )
    used, renumbered = np.unique(tetrahedra, return_inverse=True)
    return np.asarray(mesh.points, dtype=float)[used, :3] * scale, renumbered.reshape(tetrahedra.shape)
