"""Contact-aided fingers and hands."""
