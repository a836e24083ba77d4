"""Results as files for other programs: CSV, parquet and npz, each with its provenance beside it."""
