"""Backends of learned chains."""
