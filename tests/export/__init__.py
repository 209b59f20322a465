"""Tests of `spotcheck.export`."""
