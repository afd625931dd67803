"""Who runs which trial: queue, workers, storage and processes."""
