"""Ink: how numbers are drawn, and the files that a picture comes as."""
