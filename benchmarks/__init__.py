"""Speed and accuracy tables; run by one command, never part of the tests."""
