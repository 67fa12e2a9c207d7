"""API pages from docstrings, `make api`: a page a module of ours, without the two faces (cli, tui). What pdoc warns of is an error.

python benchmarks/api_pages.py build/api [MODULE ...]
"""

from __future__ import annotations

import pkgutil
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

import pdoc
import pdoc.render
from pdoc.extract import walk_specs

from openant_tools.comms.reply import Answer

PACKAGES = ("openant_tools", "openant_env", "openant_agents")
#: what is no interface: the two faces
LEFT_OUT = ("openant_tools.cli", "openant_tools.tui", "openant_tools.__main__")
#: rooms whose names are loaded when they are asked for; pdoc shows what is there
LAZY = ("openant_tools.sysid",)


def modules() -> list[str]:
    """Every module that has a page, as pdoc is told: by itself it passes over those that a package's `__all__` does not name."""
    asked = [*PACKAGES, *(f"!{name}" for name in LEFT_OUT)]
    for package in PACKAGES:
        found = set(walk_specs(asked))
        for one in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
            if one.name not in found and not one.name.startswith(LEFT_OUT):
                asked.append(one.name)
                found |= set(walk_specs([one.name]))
    return asked


def write_pages(out: Path, modules: Sequence[str]) -> int:
    """Write the pages of `modules` and what is below them; returns how many there are.

    Raises:
        Warning: a docstring, an annotation or a name that pdoc cannot resolve.
    """
    for name in LAZY:
        room = import_module(name)
        vars(room).update({one: getattr(room, one) for one in room.__all__})
    # the names in a NamedTuple's fields are not looked up in its module
    Answer.__new__.__annotations__ = get_type_hints(Answer)
    pdoc.render.configure(docformat="google")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pdoc.pdoc(*modules, output_directory=out)
    return sum(1 for _ in out.rglob("*.html"))


def main() -> None:
    out = Path(sys.argv[1])
    print(f"{out / 'index.html'}: {write_pages(out, sys.argv[2:] or modules())} pages")


if __name__ == "__main__":
    main()
