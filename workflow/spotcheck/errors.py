"""The exception for errors that the user can correct."""


class InputError(ValueError):
    """An input is wrong and the user can correct it.

    The text is one sentence: where the error is (file, row or key), what is wrong, and what to do.

    Examples
    --------
    >>> import spotcheck
    >>> try:
    ...     spotcheck.read_dataset("nowhere")
    ... except spotcheck.InputError as error:
    ...     print(error)
    /...nowhere: no such folder; a dataset is a folder with manifest.csv and frames/
    """
