"""Forms of the information matrix, and how a sample enters them, in compiled code."""
