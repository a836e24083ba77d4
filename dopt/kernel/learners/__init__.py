"""Compiled functions that update the parameters, one file for each learner."""
