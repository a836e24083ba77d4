"""Published experiments of other authors, run with one model and one energy for all policies."""
