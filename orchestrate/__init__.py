"""The effects: grids, executors and the results database around the pure :mod:`dopt`."""
