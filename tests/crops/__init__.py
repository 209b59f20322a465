"""Tests of `spotcheck.crops`."""
