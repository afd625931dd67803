"""Phases of a study: screen, shared policy, trials, finalists."""
