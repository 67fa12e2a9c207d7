"""The picture of the rooms in docs/architecture.md, drawn from what the packages import.

An arrow is an import that no way over other arrows stands for (the transitive reduction; imports within functions count).
A room's words are the first line of its package.

    python benchmarks/rooms.py [--check]
"""

from __future__ import annotations

import argparse
import ast
from pathlib import Path

import grimp

from openant_tools.errors import BadInput

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- rooms: python benchmarks/rooms.py -->", "<!-- end of rooms -->"
TOOLS = "openant_tools"
PACKAGES = (TOOLS, "openant_env", "openant_agents")


def folder_of(room: str) -> Path:
    return ROOT / room if room in PACKAGES else ROOT / TOOLS / room


def room_of(module: str) -> str | None:
    """The room that a module stands in; None for those that lie between the rooms and are imported by any."""
    first, *rest = module.split(".")
    if first != TOOLS:
        return first
    return rest[0] if rest and folder_of(rest[0]).is_dir() else None


def imports() -> dict[str, set[str]]:
    """room → the rooms that it imports."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    found: dict[str, set[str]] = {}
    for module in graph.modules:
        room = room_of(module)
        if room is not None:
            others = {room_of(other) for other in graph.find_modules_directly_imported_by(module)}
            found.setdefault(room, set()).update(other for other in others if other not in (None, room))
    return found


def reduced(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """Without each edge for which there is a longer way.

    Raises:
        BadInput: rooms import each other in a circle.
    """
    below: dict[str, set[str]] = {}

    def reach(room: str, way: tuple[str, ...]) -> set[str]:
        if room in way:
            raise BadInput(f"rooms import each other: {' → '.join((*way, room))}")
        if room not in below:
            below[room] = edges[room] | {far for next in edges[room] for far in reach(next, (*way, room))}
        return below[room]

    for room in edges:
        reach(room, ())
    return {
        room: {one for one in nexts if not any(one in below[other] for other in nexts if other != one)}
        for room, nexts in edges.items()
    }


def words(room: str) -> str:
    """The first line of a package."""
    text = ast.get_docstring(ast.parse((folder_of(room) / "__init__.py").read_text(encoding="utf-8"))) or ""
    return text.splitlines()[0]


def picture() -> str:
    """The picture and the table under it, Markdown."""
    edges = imports()
    arrows = [f"    {room} --> {one}" for room, nexts in sorted(reduced(edges).items()) for one in sorted(nexts)]
    rows = [f"| `{room}` | {words(room)} | {', '.join(sorted(edges[room])) or '–'} |" for room in sorted(edges)]
    return "\n".join(
        ["```mermaid", "flowchart TD", *arrows, "```", "", "| room | what it is | imports |", "|---|---|---|", *rows]
    )


def page(text: str) -> str:
    """The page with the picture as it is now."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}\n{picture()}\n{end}{after}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="only say whether the page is up to date")
    options = parser.parse_args()
    now = PAGE.read_text(encoding="utf-8")
    new = page(now)
    if options.check:
        raise SystemExit(0 if new == now else f"{PAGE} is out of date → python benchmarks/rooms.py")
    PAGE.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main()
