"""Benchmarks of speed and accuracy, run by `softgym bench`; their results are kept in results.json."""
