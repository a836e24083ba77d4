"""Declaration of specifications: validated dataclass fields and registries of named classes."""
