"""Many runs at once: grids of configurations over many trees, on the cores of one machine or on a Ray cluster."""
