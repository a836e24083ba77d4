"""Executor on Ray: one machine or a cluster."""
