"""Learners along gradients through time."""
