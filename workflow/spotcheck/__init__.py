"""Spotcheck: how a camera sees a laser spot on a composite, and what a simulation of it is missing.

Imports go down: cli > figures, discrepancy > estimate, metrics > model > frames, optics > dataset, store.
"""
