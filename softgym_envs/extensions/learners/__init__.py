"""Learners beside those of the core: evolution strategies and recurrent policies."""
