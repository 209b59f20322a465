"""Tests of `spotcheck.characterization`."""
