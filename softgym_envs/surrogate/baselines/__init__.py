"""Other surrogates, to compare with: the thesis' network, a residual network, radial basis functions."""
