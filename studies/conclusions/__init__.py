"""Which sentences of the paper hold, under which learner, on which plant."""
