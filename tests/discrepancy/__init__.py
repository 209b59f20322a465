"""Tests of `spotcheck.discrepancy`."""
