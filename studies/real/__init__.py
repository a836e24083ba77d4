"""Published numbers on recorded runs of real plants."""
