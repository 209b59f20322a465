"""Tests of `spotcheck.sensor`."""
