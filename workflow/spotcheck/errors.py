"""What the user can mend."""


class InputError(ValueError):
    """What the user gave cannot be used; the text is one sentence: file, row or key, what is wrong, what is right.

    Examples
    --------
    >>> import spotcheck
    >>> try:
    ...     spotcheck.read_dataset("nowhere")
    ... except spotcheck.InputError as error:
    ...     print(error)
    /...nowhere: no such folder; a dataset is a folder with manifest.csv and frames/
    """
