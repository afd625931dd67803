"""Robots of other laboratories against their public recordings: `softgym validate`."""
