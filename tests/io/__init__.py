"""Tests of `spotcheck.io`."""
