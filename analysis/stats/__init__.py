"""Statistics: intervals, paired tests, scores of trials, spectra, control."""
