"""Compiled functions that choose the next input, one file for each policy."""
