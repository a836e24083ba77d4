"""Data of an analysis: which trials are chosen, and their curves as arrays and frames."""
