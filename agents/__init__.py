"""Agents: SAC training and evaluation, baselines (random, inverse QP)."""
