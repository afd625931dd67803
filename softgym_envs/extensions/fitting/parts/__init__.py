"""Fitting of learned parts (`softgym_envs.surrogate.parts`)."""
