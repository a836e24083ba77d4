"""Results as files: tables, matrices, and bundles of all tables."""
