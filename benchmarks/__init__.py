"""Benchmarks of speed, run by `softgym bench`; their results are kept in results.json."""
