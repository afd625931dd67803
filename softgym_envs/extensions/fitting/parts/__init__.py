"""Fitting of learned parts (`softgym_envs.extensions.beams.parts`)."""
