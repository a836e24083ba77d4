"""Robots whose rigid body is known: which motion identifies what is not, planned or online."""
