"""What is learned and never named: the light's shape, each frame's brightness, width and centre, the sheet's errors."""
