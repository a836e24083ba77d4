"""Executor on a SLURM cluster: one job array, whose tasks take trials from the database."""
