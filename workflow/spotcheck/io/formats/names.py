"""File names: endings of the formats that are read, and paths inside HDF5 files."""

import re

# Formats in which a path inside the file follows the file name behind #.
HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf", ".nxs", ".nc")
IMAGE_SUFFIXES = (".tif", ".tiff", ".png", ".pgm", ".npy", *HDF5_SUFFIXES)


def split_inner_path(file: str) -> tuple[str, str]:
    """Split `file.h5#/inner/path` into the path of the file and the path inside it.

    The path inside is empty if none is named or if the file name does not end as one of an HDF5 file.
    """
    match = re.fullmatch(rf"(.+?(?:{'|'.join(map(re.escape, HDF5_SUFFIXES))}))#/*(.*)", file, re.IGNORECASE | re.DOTALL)
    return (match[1], f"/{match[2]}" if match[2] else "") if match else (file, "")
