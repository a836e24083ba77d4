"""Cost and loss against the width of the network (Figure 4)."""
