"""Questions about speed, one to a file, each answered on this machine beside its target.

``python -m benchmarks`` prints one table; ``--only step,store`` selects questions and ``--quick``
shortens them. Candidates of one question run in turn (A B A B) in one process, and medians count.
"""
