"""Bundles: folders with the tables of a results database as Parquet files, which are only read."""
