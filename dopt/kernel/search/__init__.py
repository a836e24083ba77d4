"""Compiled search for the best plan among a finite set."""
