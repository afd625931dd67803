"""Studies that many machines share: their storage in a PostgreSQL database."""
