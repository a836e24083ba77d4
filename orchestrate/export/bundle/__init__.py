"""Bundles: results as a folder of Parquet files that describes itself and that others can reuse."""
