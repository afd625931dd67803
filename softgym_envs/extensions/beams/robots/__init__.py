"""Robots made of beams that are held: Stiff-Flop and Tetrapod."""
