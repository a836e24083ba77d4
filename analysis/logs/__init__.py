"""Recorded runs: reading, and a report of their health."""
