"""Examination of a robot, of the installation and of speed: `softgym check`, `doctor`, `bench`."""
