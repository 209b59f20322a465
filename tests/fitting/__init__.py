"""Tests of `spotcheck.fitting`."""
