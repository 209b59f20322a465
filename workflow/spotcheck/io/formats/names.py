"""File names: endings of the formats that are read, and paths inside HDF5 files."""

import re

# Files with paths inside, which follow behind #.
HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf", ".nxs", ".nc")
IMAGE_SUFFIXES = (".tif", ".tiff", ".png", ".pgm", ".npy", *HDF5_SUFFIXES)


def split_inner_path(file: str) -> tuple[str, str]:
    """Return the path of a file and the path inside it, which follows behind # in names of HDF5 files.

    The path inside is empty where none is given.
    """
    found = re.fullmatch(rf"(.+?(?:{'|'.join(map(re.escape, HDF5_SUFFIXES))}))#/*(.*)", file, re.IGNORECASE | re.DOTALL)
    return (found[1], f"/{found[2]}" if found[2] else "") if found else (file, "")
