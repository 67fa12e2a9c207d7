"""Writing files so that whoever looks sees the old one or the whole new one, never a part; reading those of others; and
memory shared as a file.

What is read is bounded, in bytes, in digits and in depth, so that no file takes minutes or all memory.
"""

from __future__ import annotations

import codecs
import json
import math
import mmap
import os
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from openant_tools.errors import BadInput, OpenAntError
from openant_tools.numbers import exact

__all__ = [
    "LARGEST_TOML", "atomic_writer", "decoded", "json_text", "known", "parse_json", "parse_toml", "read_json", "read_text",
    "read_toml", "reading", "shared_memory", "write_bytes", "write_text",
]  # fmt: skip

#: bytes of a text file that is read, of a TOML file (whose readers take seconds a megabyte), and how deep its lists may nest
LARGEST_TEXT, LARGEST_TOML, DEEPEST = 256 * 2**20, 4 * 2**20, 100
#: digits of a whole number; those of 64 bits have 19 and fit every array
DIGITS = 19


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


def json_text(content: Any, *, indent: int | None = 1, default: Callable[[Any], Any] | None = None) -> str:
    """JSON that every reader takes: one document, a line's end, null where a number is not known.

    Args:
        default: makes something that JSON can hold of what it cannot.

    Raises:
        TypeError: there is something in it that JSON cannot hold.
    """
    return json.dumps(known(content), indent=indent, ensure_ascii=False, allow_nan=False, default=default) + "\n"


@contextmanager
def reading(where: str | Path, what: str, remedy: str) -> Iterator[None]:
    """A block that makes sense of a file: whatever it stumbles over becomes one line that names the file.

    Args:
        what: is wrong then, such as "this is no recording of ours". remedy: what to do.

    Raises:
        BadInput: for every error but those that name a cause already (BadInput itself, and the operating system's).
    """
    try:
        yield
    except OpenAntError:
        raise
    except Exception as error:  # of a dozen libraries, each with its own
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise BadInput(f"{what} ({type(error).__name__}: {error})", where=where, remedy=remedy) from error


def read_text(path: Path, largest: int = LARGEST_TEXT) -> str:
    """The text of a file in UTF-8, a byte order mark left out.

    Raises:
        BadInput: it is larger, no text, or a folder.
        OSError: it cannot be read.
    """
    if path.is_dir():
        raise BadInput("is a folder, not a file", where=path, remedy="name a file in it")
    with path.open("rb") as stream:
        data = stream.read(largest + 1)
    if len(data) > largest:
        raise BadInput(
            f"is larger than {exact(largest / 2**20, 'MiB')}", where=path, remedy="is it the file that you mean?"
        )
    return decoded(data, path)


def decoded(data: bytes, where: str | Path) -> str:
    """A file's bytes as text; raises BadInput, which names the line, where they are none in UTF-8."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise BadInput("is text in UTF-16, not in UTF-8", where=where, remedy="save it as UTF-8")
    try:
        return data.removeprefix(codecs.BOM_UTF8).decode("utf-8")
    except UnicodeDecodeError as error:
        place = f"{where}, line {data[: error.start].count(10) + 1}"
        raise BadInput("is no UTF-8 text", where=place, remedy="save it as UTF-8") from None


def read_json(path: Path, remedy: str = "correct it there") -> Any:
    """What a JSON file says.

    Raises:
        BadInput: it is no JSON, nests too deep or has numbers that no computer counts with; the place is named.
        OSError: it cannot be read.
    """
    return parse_json(read_text(path), path, remedy)


def parse_json(text: str | bytes, where: str | Path, remedy: str = "correct it there") -> Any:
    """As `read_json`, of a text."""
    try:
        value = json.loads(text, parse_int=_whole)
    except json.JSONDecodeError as error:
        place = f"{where}, line {error.lineno}, column {error.colno}"
        raise BadInput(f"this is not JSON: {error.msg}", where=place, remedy=remedy) from None
    except RecursionError:
        raise BadInput("its lists and tables nest too deep", where=where, remedy=remedy) from None
    except ValueError as error:
        raise BadInput(f"this is not JSON: {error}", where=where, remedy=remedy) from None
    _bounded(value, where, remedy)
    return value


def read_toml(path: Path, remedy: str = "mend it there") -> dict[str, Any]:
    """What a TOML file says; errors as of `read_json`."""
    return parse_toml(read_text(path, LARGEST_TOML), path, remedy)


def parse_toml(text: str, where: str | Path, remedy: str = "mend it there") -> dict[str, Any]:
    """As `read_toml`, of a text."""
    try:
        table = tomllib.loads(text)
    except RecursionError:
        raise BadInput("its lists and tables nest too deep", where=where, remedy=remedy) from None
    except ValueError as error:
        what, _, place = str(error).removesuffix(")").partition(" (at ")
        raise BadInput(f"is not TOML: {what}", where=f"{where}, {place}" if place else where, remedy=remedy) from None
    _bounded(table, where, remedy)
    return table


def _bounded(whole: Any, where: str | Path, remedy: str) -> None:
    left: list[tuple[Any, int]] = [(whole, 0)]
    while left:
        value, depth = left.pop()
        if depth > DEEPEST:
            raise BadInput("its lists and tables nest too deep", where=where, remedy=remedy)
        if isinstance(value, dict | list):
            left += [(inner, depth + 1) for inner in (value.values() if isinstance(value, dict) else value)]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise BadInput("has a whole number of more than 64 bits", where=where, remedy=remedy)


def _whole(digits: str) -> int:
    if len(digits.removeprefix("-")) > DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


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
