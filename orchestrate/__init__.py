"""Grids, executors and the results database: all input and output around :mod:`dopt`."""
