"""Measurements of speed that pages print, each a program: ``python -m studies.speed.scaling``."""
