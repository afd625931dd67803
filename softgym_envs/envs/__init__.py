"""Environments: robot x task x backend."""
