"""Consistency checks of a results database."""
