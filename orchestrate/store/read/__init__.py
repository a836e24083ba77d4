"""Read side of the results database: typed rows, queries of users, which launches live."""
