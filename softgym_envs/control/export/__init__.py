"""Controllers as C source: condensed model, quadratic program and PI correction in one header."""
