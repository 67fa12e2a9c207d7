"""The code of all our modules, which several tests ask about: read and parsed once a process."""

from __future__ import annotations

import ast
import functools
import gc
from dataclasses import dataclass

from places import ROOT

__all__ = ["PACKAGES", "Module", "modules"]

PACKAGES = ("openant_tools", "openant_env", "openant_agents")


@dataclass(frozen=True)
class Module:
    """A module of ours.

    Attributes:
        name: its path from the root of the repository. text: its code.
        tree: what that is parsed to. nodes: all of the tree, in the order of `ast.walk`.
    """

    name: str
    text: str
    tree: ast.Module
    nodes: tuple[ast.AST, ...]


@functools.cache
def modules() -> tuple[Module, ...]:
    """All of them, in the order of their names."""
    # Nobody looks for garbage among a million nodes: neither while they are made nor later.
    gc.disable()
    try:
        found = []
        for package in PACKAGES:
            for path in sorted((ROOT / package).rglob("*.py")):
                text = path.read_text(encoding="utf-8")
                tree = ast.parse(text)
                found.append(Module(path.relative_to(ROOT).as_posix(), text, tree, tuple(ast.walk(tree))))
        return tuple(found)
    finally:
        gc.freeze()
        gc.enable()
