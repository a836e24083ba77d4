"""Executors of trials: this process, a process pool, Ray, or torch batches."""
