"""Tests of the repository as a whole: public names, structure, documentation, release."""
