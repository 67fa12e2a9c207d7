"""Packages that the base installation leaves out: `from openant_tools.optional import cv2`.

Where one is missing, or is there and does not load, the import itself raises `NotInstalled`: one line that says what to
install. Any `cv2` will do, whichever distribution brought it.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
from dataclasses import dataclass
from typing import Any

from openant_tools.errors import BadInput

__all__ = ["NotInstalled", "OpenCV", "installed", "opencv"]

#: name here → (module, what people call it, the extra that brings it)
PACKAGES = {
    "cv2": ("cv2", "OpenCV", "camera"),
    "foxglove": ("foxglove", "Foxglove's SDK", "view"),
    "foxglove_channels": ("foxglove.channels", "Foxglove's SDK", "view"),
    "foxglove_messages": ("foxglove.messages", "Foxglove's SDK", "view"),
    "rerun": ("rerun", "Rerun", "view"),
    "pa": ("pyarrow", "pyarrow", "parquet"),
    "pc": ("pyarrow.compute", "pyarrow", "parquet"),
    "pq": ("pyarrow.parquet", "pyarrow", "parquet"),
}


class NotInstalled(BadInput):
    """A package that is not part of the base installation is wanted and cannot be had."""


def __getattr__(name: str) -> Any:
    if name not in PACKAGES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, title, extra = PACKAGES[name]
    remedy = f"pip install 'openant-tools[{extra}]'"
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and error.name.partition(".")[0] != module.partition(".")[0]:
            raise NotInstalled(f"{title} does not load: {error}", remedy=f"install that, or {remedy}") from error
        raise NotInstalled(f"this needs {title}, which is not installed", remedy=remedy) from error
    except ImportError as error:  # a graphical OpenCV on a machine without the libraries of a screen
        raise NotInstalled(
            f"{title} is installed and does not load: {error}", remedy=f"mend that, or {remedy}"
        ) from error


def installed(name: str) -> bool:
    """Whether a package of `PACKAGES` is there to be imported; it is not loaded."""
    try:
        return importlib.util.find_spec(PACKAGES[name][0].partition(".")[0]) is not None
    except ValueError:  # a module put into sys.modules by hand, without a specification
        return False


@dataclass(frozen=True)
class OpenCV:
    """Which `cv2` runs here.

    Attributes:
        version: None where there is none that loads; `fault` says why.
        file: where it was loaded from.
        brought_by: the installed distributions that own this place, as "opencv-python 4.11.0.86"; of several, the files
            of one lie over those of another.
        windows: whether `cv2.imshow` is in it.
    """

    version: str | None
    file: str | None
    brought_by: tuple[str, ...]
    windows: bool = False
    fault: str | None = None

    @property
    def words(self) -> str:
        """One line for people."""
        if self.version is None:
            return str(self.fault)
        what = f"OpenCV {self.version}, {'with' if self.windows else 'without'} windows, from {self.file}"
        if len(self.brought_by) < 2:
            return what + (f" ({self.brought_by[0]})" if self.brought_by else "")
        names = [one.partition(" ")[0] for one in self.brought_by]
        return (
            f"{what}: {' and '.join(self.brought_by)} lie over each other → "
            f"pip uninstall {' '.join(names)}, then install the one that you want"
        )


def opencv() -> OpenCV:
    """Load `cv2`, if there is one, and say where it comes from."""
    owners = []
    for one in importlib.metadata.distributions():
        name = str(one.metadata["Name"] or "")
        if name.lower().startswith("opencv") and name not in owners:
            owners.append(f"{name} {one.version}")
    brought_by = tuple(sorted(set(owners)))
    try:
        cv2 = __getattr__("cv2")
    except NotInstalled as error:
        return OpenCV(None, None, brought_by, fault=str(error))
    # A build without a window toolkit keeps the functions and refuses when they are called.
    gui = [line.partition(":")[2].strip() for line in cv2.getBuildInformation().splitlines() if "GUI:" in line]
    return OpenCV(
        str(cv2.__version__),
        str(cv2.__file__),
        brought_by,
        windows=bool(gui) and gui[0].upper() not in ("NONE", "NO", ""),
    )
