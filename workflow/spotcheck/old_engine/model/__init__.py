"""The forward model: propagation → photons → spot → sensor, each with mean and variance, and random draws of it."""
