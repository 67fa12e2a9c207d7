"""Sets of soaks for the blind check of dropout attribution: made, diagnosed, each answer sealed or open."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import tomlkit
from joblib import Parallel, delayed

from openant_tools.blind.answers import OPEN, SEALED, committed, open_answers
from openant_tools.blind.soak_tables import soak_table
from openant_tools.blind.soak_virtual import soak_virtual
from openant_tools.blind.soaks import SoakAnswer, SoakMix, draw_soaks
from openant_tools.comms.dropouts.diagnose import diagnose_dropouts
from openant_tools.errors import BadInput, OpenAntError
from openant_tools.files import parse_toml, read_json, read_text, read_toml, reading, write_text
from openant_tools.recording.tables import read_run, write_table
from openant_tools.virtual.seal import commitment_of, seal
from openant_tools.workers import tied

__all__ = ["SCHEMA", "make_soaks", "read_soak_answers", "read_verdicts", "run_soaks", "soak_facts"]

SCHEMA = "openant.blind-comms/1"

Progress = Callable[[float, str], None]


def _quiet(share: float, words: str) -> None:
    """Nobody looks."""


def _name(k: int) -> str:
    return f"soak-{k:03d}"


def make_soaks(
    out: Path,
    count: int,
    seed: int,
    *,
    mix: SoakMix | None = None,
    commit: str | None = None,
    key: bytes | None = None,
    jobs: int = 1,
    progress: Progress = _quiet,
) -> str:
    """Draw soaks and write their tables; what is there already is kept, so that it can go on.

    Returns:
        The commitment of the answers.

    Args:
        commit: whose hash gave the seed, for the record.
        key: seals the answers; None leaves them open in one file.

    Raises:
        BadInput: `out` holds something else.
    """
    mix = mix or SoakMix()
    answers = draw_soaks(count, seed, mix)
    facts: dict[str, Any] = {"schema": SCHEMA, "soaks": count, "seed": seed}
    if commit:
        facts["seed_from_commit"] = commit
    facts["mix"] = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(mix).items()}
    commitment = committed(out, facts)
    if commitment is not None:
        answers = list(read_soak_answers(out, key).values())
    else:
        plain = tomlkit.dumps({"answer": {_name(k): answer.as_table() for k, answer in enumerate(answers)}})
        if key is None:
            commitment = commitment_of(b"", plain)
            write_text(out / OPEN, plain)
        else:
            commitment = seal(plain, key, out / SEALED)
        write_text(out / "set.toml", tomlkit.dumps({**facts, "commitment": commitment}))
    todo = [k for k in range(count) if not (out / f"{_name(k)}.parquet").exists()]
    work = (delayed(tied(_make))(out, _name(k), answers[k]) for k in todo)
    for done, name in enumerate(Parallel(n_jobs=jobs, return_as="generator_unordered")(work), 1):
        progress(done / len(todo), name)
    return commitment


def _make(out: Path, name: str, answer: SoakAnswer) -> str:
    run = soak_virtual(answer, name) if answer.maker == "virtual" else soak_table(answer, name)
    write_table(run, out / f"{name}.parquet")
    return name


def soak_facts(folder: Path) -> Mapping[str, Any]:
    """What is known of a set.

    Raises:
        BadInput: this is no set of soaks.
    """
    path = folder / "set.toml"
    facts = read_toml(path) if path.is_file() else {}
    if facts.get("schema") != SCHEMA:
        raise BadInput("this is no set of soaks", where=folder, remedy="name one that `openant comms blind make` made")
    return facts


def read_soak_answers(folder: Path, key: bytes | None) -> Mapping[str, SoakAnswer]:
    """Soak → answer.

    Raises:
        BadInput: there are none, or they do not open (`open_answers`).
    """
    commitment = str(soak_facts(folder).get("commitment"))
    if (folder / SEALED).exists():
        plain = open_answers(folder / SEALED, key, commitment)
    else:
        path = folder / OPEN
        if not path.is_file():
            raise BadInput("there are no answers here", where=folder, remedy="make the set anew")
        plain = read_text(path)
    with reading(folder, "its answers are not as they were written", "make the set anew"):
        return {name: SoakAnswer.of(one) for name, one in parse_toml(plain, folder)["answer"].items()}


def run_soaks(folder: Path, *, jobs: int = 1, progress: Progress = _quiet) -> int:
    """Diagnose every soak that has no verdict yet, from its table alone; how many that were.

    A soak whose diagnosis is refused gets a verdict with `error`, which counts against it.
    """
    soak_facts(folder)
    todo = [path for path in sorted(folder.glob("soak-*.parquet")) if not _verdict(folder, path.stem).exists()]
    work = (delayed(tied(_diagnose))(folder, path) for path in todo)
    for done, name in enumerate(Parallel(n_jobs=jobs, return_as="generator_unordered")(work), 1):
        progress(done / len(todo), name)
    return len(todo)


def _verdict(folder: Path, name: str) -> Path:
    return folder / "verdicts" / f"{name}.json"


def _diagnose(folder: Path, path: Path) -> str:
    began = time.monotonic()
    try:
        found = diagnose_dropouts([read_run(path, need=())]).as_json()
        found.pop("episodes")
    except OpenAntError as error:
        found = {"verdict": None, "error": str(error), "causes": []}
    found["blind"] = {"soak": path.stem, "seconds": round(time.monotonic() - began, 2)}
    write_text(_verdict(folder, path.stem), json.dumps(found, indent=1) + "\n")
    return path.stem


def read_verdicts(folder: Path, names: Sequence[str], *, so_far: bool = False) -> Mapping[str, Mapping[str, Any]]:
    """Soak → diagnosis as JSON; with `so_far` of those alone that have one.

    Raises:
        BadInput: a soak has none.
    """
    missing = [name for name in names if not _verdict(folder, name).exists()]
    if so_far:
        names = [name for name in names if name not in missing]
    if missing and (not so_far or not names):
        raise BadInput(
            f"{len(missing)} soaks have no verdict, such as {missing[0]}",
            where=folder,
            remedy="run `openant comms blind run SET` first",
        )
    return {name: read_json(_verdict(folder, name)) for name in names}
