"""The compiled solver of bodies made of quadratic beams and rigid parts."""
