"""Tasks of robots that move ahead."""
