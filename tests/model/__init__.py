"""Tests of `spotcheck.model`."""
