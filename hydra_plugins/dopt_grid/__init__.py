"""Hydra plugin with a sweeper that composes each choice of groups once."""
