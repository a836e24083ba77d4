"""Spectrum of inputs (Figure 2, right)."""
