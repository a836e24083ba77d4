"""Loss curves (Figure 1)."""
