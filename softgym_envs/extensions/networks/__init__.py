"""Networks that the potential is compared with."""
