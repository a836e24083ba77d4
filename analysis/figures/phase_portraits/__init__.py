"""Phase portraits (Figure 2, left and middle)."""
