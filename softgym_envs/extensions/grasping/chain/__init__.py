"""Chains of learned segments: surrogates of the contact-aided finger for any number of contacts.

The finger is divided into segments between the corners of its outline (`body`). The energy of a segment is a convex
quadratic function of its elongation and of the rotations of its ends, in axes that turn with it; small networks predict
its stiffness from the shape of the segment and of its neighbours (`segments`). The sum of these energies is the learned
potential of the body without contact, so the compliance between any points follows from it. Obstacles then press on
points of the skin with the law of contact of the finite elements, and friction keeps its memory outside the networks
(`contact`): the number of contacts is free, and none of them is learned.

Since a segment is learned and not a body, 120 bodies at rest are enough data for a space of 15 design variables.
"""
