"""Constraint functions ``delta(x)``: one class per file, each with value, jacobian and second derivative."""
