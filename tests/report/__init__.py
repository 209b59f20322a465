"""Tests of `spotcheck.report`."""
