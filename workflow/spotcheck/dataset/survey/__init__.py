"""A folder of images as it is: what its files say of their frames, settled to the rows of a manifest."""
