"""Statistics that decide after some seeds whether a grid needs more of them."""
