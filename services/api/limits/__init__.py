"""What callers may store: their quotas, and room for bodies while they come."""
