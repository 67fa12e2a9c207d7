"""Which paths that stand inside a file are followed: those near it. One place for the rule.

A file may come from anybody. What it names is followed where that lies in its own folder, in the folder around that, or in the
robot's folder that it belongs to; an MJCF's includes and meshes also wherever a relative path leads from it, as MuJoCo goes.
Absolute paths and links that lead elsewhere are followed only where the builder has said so, by `--trust-paths`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

__all__ = ["TRUST", "follows", "follows_asset", "trusted"]

#: environment variable that `--trust-paths` sets, for this process and those it starts
TRUST = "OPENANT_TRUST_PATHS"
ROBOT = "robot.toml"


def trusted() -> bool:
    """Whether every path is to be followed."""
    return bool(os.environ.get(TRUST))


def follows(named: str | Path, file: Path) -> Path | None:
    """Where a path leads that stands in `file`, or None where it is not to be followed: then say so in a line."""
    folder = (file if file.is_dir() else file.parent).resolve()
    target = folder / named
    if trusted() or any(_real(target).is_relative_to(near) for near in _near(folder)):
        return target
    return None


def follows_asset(named: str | Path, folder: Path) -> bool:
    """Whether MuJoCo may open what an MJCF in `folder` names so: not by an absolute path, nor by a link elsewhere."""
    folder = folder.resolve()
    target = Path(os.path.normpath(folder / named))
    real = _real(target)
    near = any(real.is_relative_to(place) for place in _near(folder))
    return trusted() or near or (not Path(named).is_absolute() and real == target)


def _near(folder: Path) -> Iterator[Path]:
    yield folder
    if folder.parent != folder.parent.parent:  # all that there is, is near nothing
        yield folder.parent
    yield from [place for place in folder.parents if (place / ROBOT).is_file()][:1]


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))
