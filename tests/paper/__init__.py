"""Tests of `spotcheck.paper`."""
