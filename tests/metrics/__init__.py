"""Tests of `spotcheck.metrics`."""
