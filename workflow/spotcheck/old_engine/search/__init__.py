"""Forward steps with refit, rivals, ties, and the tests that a name must pass."""
