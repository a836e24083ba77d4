"""Final loss against the time of a step, with the Pareto front (Figure 6)."""
