"""Tasks: one readable file each."""
