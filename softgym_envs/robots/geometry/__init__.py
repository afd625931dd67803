"""Geometry of bodies: meshing, mesh motion, symmetry, and export to CAD files and moulds."""
