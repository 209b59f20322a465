"""Every effect's own evidence beside all nuisance: pixels, fields, stripes, noise, laws on frame numbers."""
