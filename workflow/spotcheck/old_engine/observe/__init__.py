"""Frames and crops → pixels, with mean, variance and slope under the exact law of a reading."""
