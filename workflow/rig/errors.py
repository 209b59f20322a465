"""The one exception that the command line turns into a single line of text."""


class RigError(Exception):
    """A plan or a setting that the rig cannot carry out; the message names the file and the key."""
