"""Agents of reinforcement learning as plans of a trial; they need the extra ``agents``."""
