"""Tests of `spotcheck.quicklook`."""
