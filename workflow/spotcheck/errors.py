"""What the user can mend."""


class InputError(ValueError):
    """What the user gave cannot be used; the text is one sentence: file, row or key, what is wrong, what is right."""
