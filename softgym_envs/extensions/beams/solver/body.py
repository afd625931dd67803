"""Bodies of beams and rigid parts as plain arrays, for the compiled equations of `equations`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from softgym_envs.extensions.beams.beam import Beam
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.servo import Servo
from softgym_envs.extensions.beams.solver.block_cholesky import SIZE, BlockPattern, analyse
from softgym_envs.extensions.beams.solver.points import ContactPoints, contact_points, reason_against
from softgym_envs.mechanics.assembly import MassMatrix
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.rigid import RigidBody
from softgym_envs.mechanics.frames import Frames
from softgym_envs.mechanics.model import MechanicalModel

MAX_ACTUATORS = 16
"""Complementarity problems have no more."""

FIXED, ORIGIN, DIRECTOR, MOUNTED = -1, 0, 1, 2
"""Kinds of rows: those that do not move, origins and directors of frames, and origins of frames on another frame."""


class Elements(NamedTuple):
    """Elements of all beams of a body.

    Attributes:
        frames: first rows of the frames of each element, shape (m, 3).
        shape: shape functions at the two Gauss points, shape (2, 3).
        slope: their slopes, shape (m, 2, 3).
        stiffness: weight times stiffness at the Gauss points, shape (m, 2, 6).
        rest: strains at rest, shape (m, 2, 6).
        mount: row of the origin of the frame on which each frame is mounted, or -1, shape (m, 3).
        place: block of the tangent for each pair of an element's frames, shape (m, 3, 3); -1 below the diagonal, and
            where one of them is fixed.
        drag: weight times resistance of the fluid along and across the axis, shape (m, 2, 2) [N s/m]; no elements,
            shape (0, 2, 2), for a body without.
    """

    frames: np.ndarray
    shape: np.ndarray
    slope: np.ndarray
    stiffness: np.ndarray
    rest: np.ndarray
    mount: np.ndarray
    place: np.ndarray
    drag: np.ndarray


class Rows(NamedTuple):
    """How the rows move.

    Attributes:
        kind: `FIXED`, `ORIGIN`, `DIRECTOR` or `MOUNTED`, shape (n,).
        block: block of the frame that moves each row, -1 if fixed, shape (n,).
        origin: row of the origin of this frame, shape (n,).
    """

    kind: np.ndarray
    block: np.ndarray
    origin: np.ndarray


class MovingFrames(NamedTuple):
    """Frames that can move, and what is mounted on them.

    Attributes:
        rows: rows of their origins, shape (f,).
        block: their blocks, shape (f,).
        mounted: rows that follow them besides their own directors, shape (c,).
        owner: row of the origin of the frame that these follow, shape (c,).
        moves: 1 for origins, 0 for directors, shape (c,).
        arm: coordinates in the directors of that frame [m], shape (c, 3).
    """

    rows: np.ndarray
    block: np.ndarray
    mounted: np.ndarray
    owner: np.ndarray
    moves: np.ndarray
    arm: np.ndarray


class Masses(NamedTuple):
    """The mass matrix between the own rows of frames, as a CSR matrix, and as a list of its blocks in the tangent.

    Rows that follow a frame have no mass of their own: they are linear in the rows of that frame.

    Attributes:
        pointers: shape (n + 1,).
        columns: of the matrix.
        values: of the matrix [kg].
        pairs: first rows of two frames that move, and their block of the tangent, shape (k, 3).
        entries: masses between their rows [kg], shape (k, 4, 4).
    """

    pointers: np.ndarray
    columns: np.ndarray
    values: np.ndarray
    pairs: np.ndarray
    entries: np.ndarray


class Components(NamedTuple):
    """The six components of the blocks.

    Attributes:
        free: 1 for those that are equations, 0 for those that are held, shape (b, 6).
        whole: whether all of a block are free, shape (b,).
        scale: length [m] that a unit of each moves, shape (b, 6).
    """

    free: np.ndarray
    whole: np.ndarray
    scale: np.ndarray


class Servos(NamedTuple):
    """Constraints of kind `Servo`.

    Attributes:
        number: constraint row, shape (s,).
        row: row of the director, shape (s,).
        directions: directions in which the angle is 0 and pi/2, shape (s, 2, 3).
    """

    number: np.ndarray
    row: np.ndarray
    directions: np.ndarray


class Points(NamedTuple):
    """Constraints of kind `Point` in frames.

    Attributes:
        number: first constraint row, shape (p,).
        rows: shape (p, 4).
        weights: shape (p, 4).
    """

    number: np.ndarray
    rows: np.ndarray
    weights: np.ndarray


class Chambers(NamedTuple):
    """Constraints of kind `Chamber` along elements, tangent by tangent.

    Attributes:
        number: constraint row of each chamber, shape (c,).
        rest: volume of each chamber at rest [m3], shape (c,).
        chamber: constraint row of each tangent, shape (t,).
        area: cross-section of its line [m2], shape (t,).
        frames: first rows of the frames of its element, shape (t, 3).
        weights: of the rows of these frames, shape (t, 3, 4).
        mount: row of the origin of the frame on which each frame is mounted, or -1, shape (t, 3).
        place: blocks of the tangent stiffness, as in `Elements`, shape (t, 3, 3).
    """

    number: np.ndarray
    rest: np.ndarray
    chamber: np.ndarray
    area: np.ndarray
    frames: np.ndarray
    weights: np.ndarray
    mount: np.ndarray
    place: np.ndarray


class BeamBody(NamedTuple):
    """A body whose unknowns are the six motions of each frame: one block of equations for each frame that can move."""

    elements: Elements
    rows: Rows
    frames: MovingFrames
    masses: Masses
    pattern: BlockPattern
    components: Components
    servos: Servos
    points: Points
    chambers: Chambers
    contact: ContactPoints | None


def reason_for_general(model: MechanicalModel, *, moving: bool = True) -> str | None:
    """Return why a body needs the general solver, or None for one that compiled code can solve.

    Compiled are quadratic beams and rigid parts with servos, chambers and points, and in motion what they touch.

    Args:
        model: the body.
        moving: whether it moves in time.
    """
    if not any(isinstance(block, Beam) for block in model.blocks):
        return "it has no beams"
    for block in model.blocks:
        if not isinstance(block, RigidBody | Beam):
            return f"it has elements of kind {type(block).__name__}"
        if isinstance(block, Beam) and block.order != 2:
            return "a beam has linear elements"
    if model.constraints["b"]:
        return f"it has bonds, such as '{model.constraints['b'][0].name}'"
    for constraint, _ in model.rows:
        label = f"{type(constraint).__name__} '{constraint.name}'"
        if not isinstance(constraint, Servo | Point | Chamber):
            return f"{label} is not a servo, chamber or point"
        if isinstance(constraint, Point) and constraint.embedding.node_ids.shape[1] != 4:
            return f"{label} does not lie in one frame"
        if isinstance(constraint, Chamber) and not _runs_along_elements(constraint, model):
            return f"{label} does not run along quadratic elements"
    actuators = sum(c.size for c in model.constraints["a"])
    if actuators > MAX_ACTUATORS:
        return f"it has {actuators} actuators, more than {MAX_ACTUATORS}"
    used = np.unique(np.concatenate([block.nodes_used for block in model.blocks]))
    if not np.isin(used, np.concatenate([model.frames.carried, model.frames.rows])).all():
        return "some of its nodes are not part of a frame"
    if model.contact is not None and not moving:
        return "it touches obstacles, at rest"
    return reason_against(model.contact)


def is_beam_body(model: MechanicalModel, *, moving: bool = True) -> bool:
    """Whether compiled code can solve a body; see `reason_for_general`."""
    return reason_for_general(model, moving=moving) is None


def _runs_along_elements(chamber: Chamber, model: MechanicalModel) -> bool:
    """Whether each tangent of a chamber depends on the four rows of three frames."""
    if chamber.ids.shape[1] != 12:
        return False
    rows = chamber.ids.reshape(-1, 3, 4)
    origins = np.concatenate([model.frames.rows, model.frames.carried[model.frames.moves == 1.0]])
    return bool(np.isin(rows[:, :, 0], origins).all() and (rows == rows[:, :, :1] + np.arange(4)).all())


def beam_body(model: MechanicalModel, mass: MassMatrix) -> BeamBody:
    """Return the arrays of a model for which `is_beam_body` holds, with its mass matrix."""
    kinematics, frames = model.kinematics, model.frames
    n = len(model.nodes)
    beams = [block for block in model.blocks if isinstance(block, Beam)]
    numbers = np.hstack([kinematics.number[3 * frames.rows[:, None] + np.arange(3)], kinematics.spin_number])
    movable = np.flatnonzero((numbers >= 0).any(axis=1))
    block_of_frame = np.full(len(frames), -1)
    block_of_frame[movable] = np.arange(len(movable))

    owner = np.full(n, -1)  # frame that moves each row
    owner[frames.rows] = np.arange(len(frames))
    owner[frames.carried] = frames.owner
    kind = np.full(n, FIXED)
    kind[frames.rows] = ORIGIN
    kind[frames.carried] = np.where(frames.moves == 1.0, MOUNTED, DIRECTOR)
    kind[block_of_frame[owner] < 0] = FIXED

    elements = np.concatenate([beam.rows for beam in beams])
    masses = _own_masses(mass.rows, frames, n)
    places = np.where(owner < 0, -1, block_of_frame[owner])
    coupled = masses.tocoo()
    first, second = places[coupled.row], places[coupled.col]
    moved = (first >= 0) & (second >= 0)
    element_blocks = block_of_frame[owner[elements]]
    pairs = {(int(i), int(j)) for i, j in zip(first[moved], second[moved], strict=True)}
    chambers = [(c, rows.start) for c, rows in model.rows if isinstance(c, Chamber)]
    lines = np.concatenate([np.empty((0, 12), dtype=np.int64), *(c.ids for c, _ in chambers)]).reshape(-1, 3, 4)[..., 0]
    groups = np.concatenate([element_blocks, block_of_frame[owner[lines]]])
    pairs |= {(int(i), int(j)) for group in groups for i in group for j in group if i >= 0 and j >= 0}
    contact = None
    if model.contact is not None:
        contact = contact_points(model.contact, frames, _following(frames, n), np.where(kind == FIXED, -1, places))
        pairs |= {(int(i), int(j)) for group in contact.blocks for i in group for j in group if i >= 0 and j >= 0}
    order, pattern = analyse(len(movable), pairs)
    block_of_frame[movable] = order
    block = np.where(kind == FIXED, -1, block_of_frame[owner])
    if contact is not None:
        moved_blocks = np.where(contact.blocks >= 0, order[contact.blocks], -1)
        contact = contact._replace(blocks=moved_blocks, place=_element_places(moved_blocks, pattern))

    own = (frames.rows[:, None] + np.arange(1, 4)).ravel()
    follows = ~np.isin(frames.carried, own) & (kind[frames.carried] != FIXED)

    free = np.zeros((len(movable), SIZE))
    scale = np.zeros((len(movable), SIZE))
    known = numbers[movable] >= 0
    free[order] = known
    scale[order] = np.where(known, kinematics.dof_scale[np.where(known, numbers[movable], 0)], 0.0)

    servos = [(c, rows.start) for c, rows in model.rows if isinstance(c, Servo)]
    points = [(c, rows.start) for c, rows in model.rows if isinstance(c, Point)]
    return BeamBody(
        elements=Elements(
            frames=elements,
            shape=np.ascontiguousarray(beams[0].shape),
            slope=np.concatenate([beam.slope for beam in beams]),
            stiffness=np.concatenate([beam.weights[:, :, None] * beam.element_stiffness[:, None] for beam in beams]),
            rest=np.concatenate([beam.rest for beam in beams]),
            mount=np.where(kind[elements] == MOUNTED, frames.rows[owner[elements]], -1),
            place=_element_places(block[elements], pattern),
            drag=np.concatenate([beam.weights[:, :, None] * beam.drag for beam in beams])
            if any(beam.damped for beam in beams)
            else np.empty((0, 2, 2)),
        ),
        rows=Rows(kind, block, np.where(kind == FIXED, -1, frames.rows[owner])),
        frames=MovingFrames(
            rows=frames.rows[movable],
            block=block_of_frame[movable],
            mounted=frames.carried[follows],
            owner=frames.rows[frames.owner[follows]],
            moves=frames.moves[follows],
            arm=frames.arm[follows],
        ),
        masses=_masses(masses, frames.rows[movable], order, pattern),
        pattern=pattern,
        components=Components(free, free.min(axis=1) > 0.0, scale),
        servos=Servos(
            number=np.array([start for _, start in servos], dtype=np.int64),
            row=np.array([servo.row for servo, _ in servos], dtype=np.int64),
            directions=np.array([servo.directions for servo, _ in servos]).reshape(-1, 2, 3),
        ),
        points=Points(
            number=np.array([start for _, start in points], dtype=np.int64),
            rows=np.array([p.embedding.node_ids[0] for p, _ in points], dtype=np.int64).reshape(-1, 4),
            weights=np.array([p.embedding.weights[0] for p, _ in points]).reshape(-1, 4),
        ),
        chambers=Chambers(
            number=np.array([start for _, start in chambers], dtype=np.int64),
            rest=np.array([c.area * c.rest_length for c, _ in chambers], dtype=float),
            chamber=np.repeat([start for _, start in chambers], [len(c.ids) for c, _ in chambers]).astype(np.int64),
            area=np.repeat([c.area for c, _ in chambers], [len(c.ids) for c, _ in chambers]).astype(float),
            frames=np.ascontiguousarray(lines),  # of one type with bodies in a batch: one compilation serves both
            weights=np.concatenate([np.empty((0, 12)), *(c.weights for c, _ in chambers)]).reshape(-1, 3, 4),
            mount=np.where(kind[lines] == MOUNTED, frames.rows[owner[lines]], -1),
            place=_element_places(block[lines], pattern),
        ),
        contact=contact,
    )


def _following(frames: Frames, count: int) -> csr_matrix:
    """Return ``count`` rows as combinations of the frames' own rows: those that follow a frame, of its rows."""
    own = (frames.rows[:, None] + np.arange(4)).ravel()
    follows = ~np.isin(frames.carried, own)
    carried, origin = frames.carried[follows], frames.rows[frames.owner[follows]]
    rows = np.concatenate([own, np.repeat(carried, 4)])
    columns = np.concatenate([own, (origin[:, None] + np.arange(4)).ravel()])
    values = np.column_stack([frames.moves, frames.arm])[follows].ravel()
    return csr_matrix((np.concatenate([np.ones(len(own)), values]), (rows, columns)), shape=(count, count))


def _own_masses(matrix: csr_matrix, frames: Frames, count: int) -> csr_matrix:
    """Return the mass matrix of ``count`` rows with the masses of rows that follow frames given to the frames' rows.

    Entries that vanish for some designs stay, so that all bodies of a robot have the same layout.
    """
    follow = _following(frames, count)
    found, used = csr_matrix(follow.T @ matrix @ follow), (_pattern(follow), _pattern(matrix))
    layout = csr_matrix(used[0].T @ used[1] @ used[0])
    layout.sort_indices()
    if layout.nnz:  # scipy finds no entries of type float where there are none
        rows = np.repeat(np.arange(count), np.diff(layout.indptr))
        layout.data = np.asarray(found[rows, layout.indices]).ravel()
    return layout


def _pattern(matrix: csr_matrix) -> csr_matrix:
    """Return a matrix with ones where another one has entries, zero or not."""
    return csr_matrix((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)


def _masses(matrix: csr_matrix, rows: np.ndarray, blocks: np.ndarray, pattern: BlockPattern) -> Masses:
    """Return the mass matrix between rows, and its parts between moving frames of given first rows and blocks."""
    pairs, entries = [], []
    for row, i in zip(rows, blocks, strict=True):
        near = matrix[row : row + 4].tocsc()
        for other, j in zip(rows, blocks, strict=True):
            if j < i or not near.indptr[other] < near.indptr[other + 4]:
                continue
            pairs.append((row, other, pattern.place(i, j)))
            entries.append(near[:, other : other + 4].toarray())
    return Masses(
        pointers=matrix.indptr.astype(np.int64),
        columns=matrix.indices.astype(np.int64),
        values=matrix.data,
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 3),
        entries=np.array(entries).reshape(-1, 4, 4),
    )


def _element_places(blocks: np.ndarray, pattern: BlockPattern) -> np.ndarray:
    """Place of the block of each pair of k frames of an element (m, k, k); -1 where a frame is fixed, or below."""
    places = np.full((*blocks.shape, blocks.shape[1]), -1)
    for e, group in enumerate(blocks):
        for a, i in enumerate(group):
            for b, j in enumerate(group):
                if 0 <= i <= j:
                    places[e, a, b] = pattern.place(i, j)
    return places
