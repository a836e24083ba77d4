"""Control with the learned model (Figure 5)."""
