"""Plain arrays in a file (.npz, uncompressed): nothing of it is executed, and nothing is larger than the file says it is."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.files import atomic_writer

__all__ = ["read_arrays", "write_arrays"]

#: numbers and truths; neither objects, which are pickles, nor texts or records
KINDS = "fiub"


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays of numbers by their names; the file appears whole or not at all."""
    with atomic_writer(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # its stub takes the names for options


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """What `write_arrays` wrote.

    Raises:
        BadInput: the file is cut, altered, compressed, or holds anything but arrays of numbers.
        OSError: it cannot be opened.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            # As they are stored, so that none is larger in memory than it is on the disk.
            if sum(entry.file_size for entry in entries) > path.stat().st_size:
                raise ValueError("it is compressed")
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise ValueError("it is compressed")
            return {entry.filename.removesuffix(".npy"): _array(archive.read(entry)) for entry in entries}
    except (ValueError, EOFError, KeyError, NotImplementedError, RuntimeError, zipfile.BadZipFile) as error:
        raise BadInput(f"holds no plain arrays ({error})", where=path) from None


def _array(data: bytes) -> NDArray[Any]:
    """One array in the bytes of an .npy file."""
    stream = BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("another version of the format")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    values = data[stream.tell() :]
    if dtype.kind not in KINDS or any(length < 0 for length in shape):
        raise ValueError(f"an array of {dtype}")
    if len(values) != dtype.itemsize * int(np.prod(shape, dtype=object)):
        raise ValueError("an array of another size")
    return np.frombuffer(values, dtype).reshape(shape, order="F" if fortran else "C").copy()
