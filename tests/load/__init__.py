"""The world as it is, measured: programmes, not tests. `kills` ends runs at random moments and runs them again."""
