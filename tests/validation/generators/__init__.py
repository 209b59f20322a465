"""Generators of data sets of which the truth is known, or part of it; what one is says tests.validation.protocol."""
