"""Estimators as C source: learned model and distributions over the places of a touch in one header."""
