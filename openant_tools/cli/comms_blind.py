"""`openant comms blind`: judge the attribution of dropouts on soaks whose faults are sealed."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli import blind_sets as sets
from openant_tools.cli.log import mention
from openant_tools.cli.options import Number, json_option, out_option
from openant_tools.cli.progress import progress_bar

__all__ = ["blind"]


@click.group()
def blind() -> None:
    """Judge the diagnosis of the bus on soaks whose faults are sealed."""


@blind.command()
@out_option
@click.option("--soaks", "count", type=click.IntRange(1, 10_000), default=320, show_default=True, metavar="N")
@sets.seed_option
@sets.seed_from_option
@click.option("--healthy", type=Number(0, 1), metavar="SHARE", help="Healthy soaks. Default a third.")
@click.option("--virtual", type=Number(0, 1), metavar="SHARE", help="From the virtual robot. Default 0.25.")
@sets.key_option
@click.option("--open", "unsealed", is_flag=True, help="Leave the answers open: for development.")
@sets.jobs_option("Soaks")
def make(
    out: Path,
    count: int,
    seed: int | None,
    commit: str | None,
    healthy: float | None,
    virtual: float | None,
    key_file: Path | None,
    unsealed: bool,
    jobs: int,
) -> None:
    """Draw soaks and write their run tables; what is there already is kept.

    \b
      openant comms blind make --out set --seed-from v1.0 --key-file set.key
      openant comms blind make --out dev --soaks 60 --seed 1 --open
    """
    from openant_tools.blind.soak_set import make_soaks
    from openant_tools.blind.soaks import SoakMix

    drawn_from, full = sets.seed_of_set(seed, commit)
    key = sets.key_of_set(out, key_file, unsealed)
    usual = SoakMix()
    mix = SoakMix(usual.healthy if healthy is None else healthy, usual.virtual if virtual is None else virtual)
    with progress_bar() as progress:
        commitment = make_soaks(out, count, drawn_from, mix=mix, commit=full, key=key, jobs=jobs, progress=progress)
    click.echo(f"{count} soaks in {out}")
    click.echo(f"commitment of their answers: {commitment}")


@blind.command()
@sets.set_argument
@sets.jobs_option("Soaks")
def run(folder: Path, jobs: int) -> None:
    """Diagnose every soak of SET that has no verdict yet; it may be stopped and goes on where it was."""
    from openant_tools.blind.soak_set import run_soaks

    with progress_bar() as progress:
        done = run_soaks(folder, jobs=jobs, progress=progress)
    click.echo(f"{done} soaks diagnosed, verdicts in {folder / 'verdicts'}")


@blind.command()
@sets.set_argument
@sets.key_option
@sets.docs_option
@click.option("--so-far", is_flag=True, help="Only soaks that have a verdict; the page says so.")
@json_option
def score(folder: Path, key_file: Path | None, docs: Path | None, so_far: bool, json_file: Path | None) -> None:
    """Open the answers of SET and compare: exit code 1 where a figure lies below what is asked for."""
    from openant_tools.blind.soak_score import score_soaks, table_lines, write_soak_docs
    from openant_tools.files import json_text, write_text
    from openant_tools.virtual.seal import read_key

    found = score_soaks(folder, None if key_file is None else read_key(key_file), so_far=so_far)
    for line in table_lines(found):
        click.echo(line)
    click.echo(f"{len(found.failures)} of {len(found.cases)} soaks went wrong")
    if json_file:
        write_text(json_file, json_text(found.as_json()))
    if docs:
        write_soak_docs(found, docs)
        mention(f"wrote {docs}")
    if not found.good:
        click.get_current_context().exit(1)
