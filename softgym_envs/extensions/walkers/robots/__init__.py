"""Robots that nothing holds."""
