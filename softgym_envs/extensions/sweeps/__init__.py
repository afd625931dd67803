"""Sweeps: many configurations of trainings with several seeds, their tables and learning curves."""
