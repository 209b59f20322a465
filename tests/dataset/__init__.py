"""Tests of `spotcheck.dataset`."""
