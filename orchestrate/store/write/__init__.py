"""Write side of the results database: registration, claims, results, launches."""
