"""The default surrogate: a network that learns the condensed energy."""
