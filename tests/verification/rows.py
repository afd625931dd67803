"""Rows of the tables of verification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TypeVar

import numpy as np

NAN = float("nan")


@dataclass(frozen=True)
class Row:
    """One computed value.

    Args:
        case: what is computed.
        setting: scheme, step or mesh, in words.
        value: computed.
        reference: exact, published or computed by other means; NaN where there is none.
        error: defined by the case; NaN where there is none.
        order: observed order of the error since the row before, whose step or mesh is twice as coarse; NaN for the
            first row.
    """

    case: str
    setting: str
    value: float
    reference: float = NAN
    error: float = NAN
    order: float = NAN


@dataclass(frozen=True)
class MeshRow:
    """One computed value of a static case.

    Args:
        case: what is computed.
        element: element, and material where it matters.
        level: the mesh, in words.
        unknowns: number of equations.
        value: computed.
        reference: exact or published; NaN where the reference is another of our own solutions.
        error: relative to the reference, or as the case says.
        order: observed order of the error since the row before, whose elements are twice as large; NaN for the first
            row.
    """

    case: str
    element: str
    level: str
    unknowns: int
    value: float
    reference: float
    error: float
    order: float = NAN


@dataclass(frozen=True)
class CheckedRow:
    """One computed value that has a tolerance.

    Args:
        case: what is computed.
        setting: mesh or parameters, in words.
        value: computed.
        reference: exact.
        error: relative to the reference, or as the case says.
        tolerance: of the error.
    """

    case: str
    setting: str
    value: float
    reference: float
    error: float
    tolerance: float


AnyRow = TypeVar("AnyRow", Row, MeshRow)
LabelledRow = TypeVar("LabelledRow", Row, MeshRow, CheckedRow)


def with_orders(rows: Sequence[AnyRow], floor: float = 0.0) -> list[AnyRow]:
    """Return rows with observed orders; each row has half the step or cell size of the one before.

    Args:
        rows: of one case, from coarse to fine.
        floor: errors up to this size are round-off and have no order.
    """
    result = list(rows[:1])
    for before, row in zip(rows, rows[1:], strict=False):
        first, second = abs(before.error), abs(row.error)
        known = first > floor and second > floor
        result.append(replace(row, order=float(np.log2(first / second)) if known else NAN))
    return result


def as_results(rows: Sequence[LabelledRow], *labels: str) -> dict[str, object]:
    """Return rows as plain data for JSON: the labels joined by ``|``, then the other fields; NaN becomes None."""
    return {
        " | ".join(getattr(row, label) for label in labels): {
            key: None if isinstance(value, float) and np.isnan(value) else value
            for key, value in asdict(row).items()
            if key not in labels
        }
        for row in rows
    }
