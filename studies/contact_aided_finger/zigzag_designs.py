"""The contact-aided fingers of the thesis (section 3.4) that were built, and what was measured on them."""

from __future__ import annotations

MM = 1e-3


def _design(walls: tuple[float, float, float], distances: tuple[float, ...]) -> dict[str, float]:
    """Return a design [m] from the thicknesses of left leg, top wall and right leg, and the distances [mm]."""
    named = {f"e{k}": MM * value for k, value in enumerate(walls, 1)}
    return named | {f"d{k}": MM * value for k, value in enumerate(distances)}


DESIGNS: dict[str, dict[str, float]] = {
    "A": _design((8.0, 5.0, 4.0), 12 * (21.0,)),
    "B": _design((14.43, 11.03, 7.81), (18.2, 23.0, 25.5, 25.7, 24.6, 22.9, 8.7, 20.2, 13.5, 23.0, 21.4, 15.7)),
    "203": _design((14.7, 3.2, 9.7), (12.2, 17.3, 13.1, 15.1, 18.1, 28.0, 20.9, 9.0, 18.3, 19.3, 10.6, 18.1)),
}
"""Baseline A, design B of figure 3.18 (trial 261 of the authors' study 19), and the finger printed as number 203."""

SIMULATED = {"A": (0.65, 0.154, 0.296), "B": (4.32, 0.075, 1.49), "C": (1.88, 0.142, 0.654)}
"""Contact force [N], resistance and energy that the authors simulated (table 3.7). Design C is not published."""

MEASURED = {"A": (0.63, 0.155, 0.308), "B": (0.87, 0.320, 1.247), "C": (0.69, 0.430, 0.769)}
"""The same, measured by the authors."""

FORCE_203 = (0.0, 0.0, 0.0, 0.0, 0.0, 8.8, 57.6, 106.4, 155.2, 204.0)
"""Contact force of finger 203 in ten steps to 40 degrees [gram-force]. The last five values lie on a straight line."""
