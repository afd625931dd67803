"""Bodies of beams: the compiled solver of their equilibria and motions, robots made of them, and learned parts."""
