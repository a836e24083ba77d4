"""From an information objective to the input that maximises it."""
