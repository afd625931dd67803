"""Solvers: linear systems, static equilibrium, time stepping, complementarity."""
