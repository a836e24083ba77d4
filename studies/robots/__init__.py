"""Robots with a known body: what is learned while they move, in simulation."""
