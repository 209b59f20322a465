"""File names: endings of the formats that are read, and paths inside HDF5 files."""

import re

# Endings of HDF5 files, whose names may be followed by # and a path inside the file; and of all formats that are read.
HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf", ".nxs", ".nc")
IMAGE_SUFFIXES = (".tif", ".tiff", ".png", ".pgm", ".npy", *HDF5_SUFFIXES)


def split_inner_path(file: str) -> tuple[str, str]:
    """Return the path of the file and the path inside it of a text such as `file.h5#/inner/path`.

    The path inside starts with one slash; it is "" if none is given. Behind another ending than one of `HDF5_SUFFIXES`,
    # is a part of the file name.
    """
    match = re.fullmatch(rf"(.+?(?:{'|'.join(map(re.escape, HDF5_SUFFIXES))}))#/*(.*)", file, re.IGNORECASE | re.DOTALL)
    return (match[1], f"/{match[2]}" if match[2] else "") if match else (file, "")
