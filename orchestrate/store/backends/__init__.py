"""Database backends: SQLite and PostgreSQL, their connections, locks, errors and backups."""
