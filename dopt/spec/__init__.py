"""Trial specifications: their parts, which of them go together, and what a trial needs."""
