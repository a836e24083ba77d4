"""Final loss against single settings (Figure 8)."""
