"""The table of names: sets on real light (`light`), and sets of the rig on which the engine before was scored."""
