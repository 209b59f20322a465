"""Datasets, frames, models and findings that several tests make."""
