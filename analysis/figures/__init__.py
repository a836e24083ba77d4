"""Figures: selection and drawing of each in one file; means and intervals come from stats."""
