"""A stored trial as a moving picture."""
