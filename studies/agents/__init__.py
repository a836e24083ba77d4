"""Agents of reinforcement learning as policies, which learn their actions step by step."""
