"""Outputs: the registry of figures and tables, and what is written for each."""
