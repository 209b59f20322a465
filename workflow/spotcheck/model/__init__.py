"""The forward model: law of the exposure → light of the spot → pixels → sensor; mean, variance and random frames."""
