"""Configuration of a launch: overrides, sweeps and the grid of trials that they ask for."""
