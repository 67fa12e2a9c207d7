"""Where what was simulated for a recording, and what was found, is kept, for nobody but this user, and how it stays small."""

from __future__ import annotations

import functools
import hashlib
import os
from importlib.metadata import version
from pathlib import Path

import openant_tools
from openant_tools.errors import BadInput

__all__ = ["CACHE_VARIABLE", "cache_folder", "code", "keep_small"]

#: the environment variable that names the cache, and how large it may grow
CACHE_VARIABLE = "OPENANT_CACHE"
LARGEST_BYTES = 2**30
PRIVATE = 0o700
#: packages whose results these are as well
COMPUTE = ("mujoco", "numpy", "scipy")


def cache_folder() -> Path:
    """The folder, made where it is not there yet.

    Raises:
        BadInput: the folder is another user's.
    """
    given = os.environ.get(CACHE_VARIABLE)
    base = Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "openant"
    folder = base / "gap"
    if folder.exists() and (mode := folder.stat()).st_uid != _user():
        raise BadInput(
            f"the cache belongs to another user (number {mode.st_uid})",
            where=folder,
            remedy=f"name a folder of your own by {CACHE_VARIABLE}",
        )
    folder.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
    folder.chmod(PRIVATE)  # where an older version made it
    return folder


@functools.cache
def code() -> str:
    """What results follow from beside what they are of: this package, word by word, and those that compute."""
    root = Path(openant_tools.__file__).parent
    state = hashlib.sha256(" ".join(map(version, COMPUTE)).encode())
    for place in sorted([*root.rglob("*.py"), *root.rglob("*.json")]):
        state.update(place.read_bytes())
    return state.hexdigest()


def _user() -> int:
    """This user's number; 0, as files have it, where users have none (Windows)."""
    return os.geteuid() if hasattr(os, "geteuid") else 0


def keep_small(newest: Path) -> None:
    """Drop what was used longest ago until the cache is within its bound."""
    places = sorted((one for one in cache_folder().iterdir() if one.is_file()), key=lambda one: one.stat().st_mtime)
    total = {place: place.stat().st_size for place in places}
    for place in places:
        if sum(total.values()) <= LARGEST_BYTES:
            return
        if place != newest:
            place.unlink(missing_ok=True)
            del total[place]
