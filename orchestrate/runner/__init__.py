"""Runs of grids and single trials: scheduling, retries, signals, progress."""
