"""Benchmarks of speed, each question a function, measured on this machine beside its target.

``python -m benchmarks`` prints one table; ``--only step,store`` selects questions and ``--quick``
shortens them. Candidates of one question run in turn (A B A B) in one process, and medians count.
"""
