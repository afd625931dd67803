"""Scheduling of trials: queue, workers, storage and processes."""
