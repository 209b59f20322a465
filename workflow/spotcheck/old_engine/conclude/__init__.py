"""What is said of a set of frames: whether anything disagrees, and what is left."""
