"""Answers about a results database: progress of a grid, one trial."""
