"""Numerics that the reference and the kernel share: maximisation on a sphere, directions."""
