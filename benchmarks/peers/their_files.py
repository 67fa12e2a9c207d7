"""A repository of others, cloned for as long as it is used, whose files stay as they are."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: by which a peer says that it could not be run here
NOT_RUN = 77


@contextmanager
def cloned(source: str) -> Iterator[tuple[Path, str]]:
    """Its folder, and its commit in words.

    Args:
        source: a place that git can clone from; where it cannot, this program ends with `NOT_RUN`.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "clone")
        clone = ["git", "clone", "-q", "--depth", "1", source, str(folder)]
        git = subprocess.run(clone, capture_output=True, text=True, timeout=120, check=False)
        if git.returncode:
            print(f"it cannot be cloned: {git.stderr.strip()}")
            sys.exit(NOT_RUN)
        yield folder, _git(folder, "log", "-1", "--format=%h of %cs")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
        assert not changed, changed


def _git(folder: Path, *words: str) -> str:
    return subprocess.run(["git", *words], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()
