"""Figures: drawing of measured numbers, with one folder for each figure."""
