"""Tables of comparisons and final losses."""
