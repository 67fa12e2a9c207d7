"""Writing files so that whoever looks sees the old one or the whole new one, never a part; and memory shared as a file."""

from __future__ import annotations

import json
import math
import mmap
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

__all__ = ["atomic_writer", "json_text", "known", "shared_memory", "write_bytes", "write_text"]


@contextmanager
def atomic_writer(path: str | Path) -> Iterator[IO[bytes]]:
    """A binary stream that takes `path`'s place once the block is left; left by an error, it leaves nothing behind.

    The bytes go to a temporary file in the same directory (which is made where it is missing), are synced to the disk
    and renamed over `path`: a full disk, a kill or a power cut leaves what stood there before. What is no file (a pipe,
    /dev/stdout, /dev/null) is written into, and stays what it is.

    Raises:
        OSError: the directory cannot be written, or the disk is full; `filename` names `path`.
    """
    path = Path(path)
    if path.parent == Path("/dev") or (path.exists() and not path.is_file() and not path.is_dir()):
        try:
            with path.open("wb") as stream:
                yield stream
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        with os.fdopen(descriptor, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes private files; what a tool writes for others to read follows the user's umask.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename in (None, temporary):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write `data` to `path` by `atomic_writer`."""
    with atomic_writer(path) as stream:
        stream.write(data)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 to `path` by `atomic_writer`."""
    write_bytes(path, text.encode())


def known(content: Any) -> Any:
    """The same JSON content with None for every number that is none (NaN, infinity), which JSON does not have."""
    if isinstance(content, Mapping):
        return {key: known(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [known(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def json_text(content: Any, *, indent: int | None = 1) -> str:
    """JSON that every reader takes: one document, a line's end, null where a number is not known.

    Raises:
        TypeError: there is something in it that JSON cannot hold.
    """
    return json.dumps(known(content), indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def shared_memory(size: int, fd: int | None = None) -> tuple[int, mmap.mmap]:
    """Memory that other processes can open by its file descriptor, which is theirs and ours to close.

    Args:
        size: bytes.
        fd: of memory that another process made; None makes it, of zeros and without a name.

    Returns:
        The file descriptor, and the memory.
    """
    if fd is None:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
        os.ftruncate(fd, size)
    return fd, mmap.mmap(fd, size)
