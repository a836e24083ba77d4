"""Animation of a stored trial."""
