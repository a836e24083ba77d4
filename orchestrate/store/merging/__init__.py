"""Merging of one results database into another."""
