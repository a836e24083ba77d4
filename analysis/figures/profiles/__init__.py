"""Performance profiles over all systems (Figure 7)."""
