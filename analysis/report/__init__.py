"""One page that compares everything that a database holds: every policy, model and learner."""
