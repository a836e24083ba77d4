"""Figures: numbers and drawing of each, in one file."""
