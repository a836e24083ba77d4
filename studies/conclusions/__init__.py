"""Verdicts on the sentences of the paper, by learner and plant."""
