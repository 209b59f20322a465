"""Several datasets side by side: their numbers with errors, what changed beyond them, and trends."""
