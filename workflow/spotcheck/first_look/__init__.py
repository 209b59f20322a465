"""A first look at images that nobody has described: what each shows, and what all of them show together."""
