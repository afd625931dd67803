"""Bodies that move: walking, crawling and swimming robots, their tasks, and learners of gaits."""
