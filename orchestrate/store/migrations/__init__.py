"""Alembic migrations from schemas 5 and 6; a script has the number of the schema it makes."""
