"""Examination of a robot before work is spent on it: `softgym check`."""
