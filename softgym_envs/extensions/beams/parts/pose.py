"""What a learned leg knows of the relative pose of its ends, of its weight and of its shape.

A leg lies in a plane: axis 1 of a port runs along it, axis 2 is normal to the plane. All quantities are without
dimensions: lengths over the leg's length L, moments over EI / L with the bending stiffness EI in its plane. The
features are those of the mean frame of both ends, which halves their turn in the plane, so a leg may turn by more than
90 degrees between its ends.

The mirror image in the plane has the same energy. Features that change sign in the mirror enter by their products only.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from softgym_envs.extensions.beams.parts.jets import HALF_PI

PLACE, TURN, WEIGHT = slice(0, 3), slice(3, 12), slice(12, 15)
"""Coordinates of a pose: place of the far port in the axes of the near one over L (3,), components ``n_i . f_j`` of
the far axes in the near ones, row by row (9,), and weight of the leg in the near axes over EI / L^2 (3,)."""

COORDINATES = 15
EVEN, ODD = 18, 6
"""Numbers of features that keep and change their sign in the mirror image."""
PRODUCTS = [(i, j) for i in range(ODD) for j in range(i, ODD)]
"""Pairs of odd features, of which the energy is a quadratic form."""

OUTPUTS = 1 + 2 * len(PRODUCTS)
"""Outputs of the network: an energy that does not depend on the odd features, and two quadratic forms of them."""
PRODUCT_SCALE, FORM_SCALE, OFFSET_SCALE = 3.0, 10.0, 3.0
"""Scales of the products as inputs, of the quadratic forms, and of the first output."""
STIFFEST = 0.05
"""Bending out of the plane is ``(w / t)^2`` times as stiff; far above the inverse of this, legs twist instead."""

SLACK = 0.02
"""Rounding of the slack of a leg, the part of its length that its ends leave, over its length."""


class Features(NamedTuple):
    """Features of poses; each entry is a number with derivatives, a column of values, or a constant.

    Attributes:
        even: those that keep their sign in the mirror image.
        odd: those that change it.
        turn: turn of the far end in the plane [rad].
    """

    even: list[Any]
    odd: list[Any]
    turn: Any


def features(y: Any, shape: Any, log: Any, maths: Any) -> Features:
    """Return the features of poses.

    Args:
        y: the coordinates, 15 numbers.
        shape: width and thickness over the length, and three printed curvatures times it: 5 numbers.
        log: function of the constant shape, such as `numpy.log`.
        maths: functions of the numbers ``y``: `JetFunctions`, or those of torch.
    """
    p0, p1, p2 = y[0:3]
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = y[3:6], y[6:9], y[9:12]
    g0, g1, g2 = y[12:15]
    width, thickness, *curvatures = shape
    turn = maths.atan2(-(r00 + r22), r02 - r20)  # less 90 degrees, about which legs turn most
    half = 0.5 * (turn + HALF_PI)
    c, s = maths.cos(half), maths.sin(half)
    # Place, weight and the remaining rotation in the mean frame, turned by half about axis 2.
    a00, a01, a02 = c * r00 - s * r20, c * r01 - s * r21, c * r02 - s * r22
    s00, s01, s02 = a00 * c + a02 * s, a01, a02 * c - a00 * s
    s10, s12 = r10 * c + r12 * s, r12 * c - r10 * s
    s21 = s * r01 + c * r21
    far = maths.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
    along_near = p0 / far
    along_far = (p0 * r00 + p1 * r10 + p2 * r20) / far
    slack = SLACK * maths.softplus((1.0 - far) * (1.0 / SLACK))
    # A taut leg resists through the angles of its ends over its slack.
    lift = (2.0 - along_near - along_far) / slack
    ratio = log(width / thickness)
    even = [
        turn,
        4.0 * (c * p0 - s * p2) - 3.2,
        4.0 * (s * p0 + c * p2),
        4.0 * far - 3.4,
        2.0 * along_near - 1.0,
        2.0 * along_far - 1.0,
        maths.log(lift + 1.0) - 1.5,
        maths.log(slack) + 2.0,
        4.0 * r11 - 3.8,
        4.0 * s00 - 3.88,
        4.0 * s02,
        0.25 * (c * g0 - s * g2),
        0.25 * (s * g0 + c * g2),
        ratio - 0.8,
        3.0 * log(thickness / 0.026),
        *curvatures,
    ]
    odd = [p1, s10, s01, s12, s21, 0.1 * g1]
    return Features(even, odd, turn)
