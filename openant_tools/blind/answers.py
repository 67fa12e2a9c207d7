"""The answers of a set: open beside the runs while a diagnosis is built, sealed where it is judged.

Sealed, all answers of a set stand in one file, encrypted by the seal of scenarios (AES-256-GCM); its commitment, the SHA-256
of a random salt and the plain text, stands in `set.toml` and is to be committed before the diagnosis is tuned.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit

from openant_tools.blind.draw import Answer
from openant_tools.errors import BadInput
from openant_tools.files import parse_toml, read_toml, reading, write_text
from openant_tools.virtual.seal import commitment_of, open_sealed, seal

__all__ = ["OPEN", "SEALED", "committed", "open_answers", "read_answers", "write_answers"]

SEALED, OPEN = "answers.sealed.toml", "truth.toml"


def committed(out: Path, facts: Mapping[str, Any]) -> str | None:
    """What the set of these facts committed to, where it stands there already; None in a new or empty folder.

    Raises:
        BadInput: `out` holds something else.
    """
    path = out / "set.toml"
    if path.exists():
        there = read_toml(path)
        if {name: there.get(name) for name in facts} != facts or "commitment" not in there:
            raise BadInput("another set is here already", where=path, remedy="name another folder")
        return str(there["commitment"])
    if out.exists() and any(out.iterdir()):
        raise BadInput("the folder is not empty", where=out, remedy="name a new one")
    return None


def write_answers(out: Path, answers: Mapping[str, Answer], key: bytes | None) -> str:
    """Write the answers of these robots; their commitment."""
    tables = {name: answer.as_table() for name, answer in answers.items()}
    if key is not None:
        return seal(tomlkit.dumps({"answer": tables}), key, out / SEALED)
    for name, table in tables.items():
        write_text(out / name / OPEN, tomlkit.dumps(table))
    return commitment_of(b"", tomlkit.dumps({"answer": tables}))


def read_answers(folder: Path, key: bytes | None, commitment: str) -> Mapping[str, Answer]:
    """Robot → answer.

    Raises:
        BadInput: there are none, or they do not open (`open_answers`).
    """
    path = folder / SEALED
    if not path.exists():
        found = sorted(folder.glob(f"*/{OPEN}"))
        if not found:
            raise BadInput(
                "there are no answers here", where=folder, remedy="name a set that `openant gap blind make` made"
            )
        with reading(folder, "its answers are not as they were written", "make the set anew"):
            return {file.parent.name: Answer.of(read_toml(file)) for file in found}
    plain = open_answers(path, key, commitment)
    with reading(path, "its answers are not as they were written", "make the set anew"):
        return {name: Answer.of(one) for name, one in parse_toml(plain, path)["answer"].items()}


def open_answers(path: Path, key: bytes | None, commitment: str) -> str:
    """The plain text of a set's sealed answers.

    Raises:
        BadInput: the seal needs a key, does not open, or is not the one that was committed to.
    """
    if key is None:
        raise BadInput("the answers are sealed", where=path, remedy="name the key by --key-file")
    table = read_toml(path)
    sealed = table.get("sealed")
    if not isinstance(sealed, dict) or sealed.get("commitment") != commitment:
        raise BadInput(
            "the answers are not those that the set committed to", where=path, remedy="take the set's own file"
        )
    return open_sealed(table, key, path)
