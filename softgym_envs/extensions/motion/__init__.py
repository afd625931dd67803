"""Motion of bodies on surrogates: learned inertia, and the time steps that it makes possible."""
