"""Hybrid backends whose states depend on the path."""
