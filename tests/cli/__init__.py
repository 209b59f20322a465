"""Tests of `spotcheck.cli`."""
