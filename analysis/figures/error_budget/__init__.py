"""Error budgets of systems: floor, exploration and learner."""
