"""Coverage of the intervals by which a launch decides how many seeds it needs."""
