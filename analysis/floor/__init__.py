"""Floor and error budget of systems, from offline fits of the models of stored trials."""
