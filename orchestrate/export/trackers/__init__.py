"""Results as runs of experiment trackers, written by the trackers' own libraries."""
