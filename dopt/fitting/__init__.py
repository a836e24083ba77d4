"""Fits of a plant's constants and of a network to recorded logs, by the error of simulations."""
