"""What `openant gap blind` and `openant comms blind` share: sets, their seeds, and the keys of their answers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from openant_tools.errors import BadInput

__all__ = [
    "docs_option", "jobs_option", "key_of_set", "key_option", "seed_from_option", "seed_of_set", "seed_option", "set_argument",
]  # fmt: skip

set_argument = click.argument("folder", type=click.Path(path_type=Path), metavar="SET")
seed_option = click.option("--seed", type=click.IntRange(0), metavar="S", help="Of everything that is drawn.")
seed_from_option = click.option(
    "--seed-from", "commit", metavar="COMMIT", help="Take the seed from a commit's hash: nobody chose it."
)
key_option = click.option(
    "--key-file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="The key of the answers."
)
docs_option = click.option(
    "--docs", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Write the page of the docs."
)


def jobs_option(what: str) -> Callable[[click.decorators.FC], click.decorators.FC]:
    """`--jobs`, of robots or soaks."""
    return click.option(
        "--jobs", type=click.IntRange(1), default=1, show_default=True, metavar="N", help=f"{what} at the same time."
    )


def seed_of_set(seed: int | None, commit: str | None) -> tuple[int, str | None]:
    """The seed that was named by itself or by a commit, and that commit's full hash.

    Raises:
        BadInput: both, neither, or a commit that is not here.
    """
    from openant_tools.blind.make import seed_of_commit

    if commit is not None:
        if seed is not None:
            raise BadInput("a set has one seed", remedy="give --seed or --seed-from, not both")
        return seed_of_commit(commit)
    if seed is None:
        raise BadInput("a set needs a seed", remedy="give --seed-from COMMIT, or --seed S")
    return seed, None


def key_of_set(out: Path, key_file: Path | None, unsealed: bool) -> bytes | None:
    """The key that seals a set's answers, made where there is none yet; None where they are to lie open.

    Raises:
        BadInput: neither or both were asked for, or the key would lie in the set.
    """
    from openant_tools.virtual.seal import make_key, read_key

    if unsealed == (key_file is not None):
        raise BadInput("the answers are to be sealed or open", remedy="give --key-file FILE or --open")
    if key_file is None:
        return None
    if key_file.resolve().is_relative_to(out.resolve()):
        raise BadInput("the key would lie beside what it seals", where=key_file, remedy="keep it outside the set")
    return read_key(key_file) if key_file.exists() else make_key(key_file)
