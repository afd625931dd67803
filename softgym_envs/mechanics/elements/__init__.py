"""Element blocks: energy, forces and exact tangents of solids, beams and rigid parts."""
