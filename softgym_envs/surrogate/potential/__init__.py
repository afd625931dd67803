"""The potential network: an ensemble of convex or free energies of actuation and design."""
