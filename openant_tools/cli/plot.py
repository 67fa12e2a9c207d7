"""`openant plot`: learning curves of several runs in one picture."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli.log import mention
from openant_tools.cli.options import json_option
from openant_tools.numbers import number

__all__ = ["plot"]


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path, file_okay=False), metavar="DIR…")
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), default=Path("learning_curves.png"), show_default=True,
    metavar="FILE", help="The picture: PNG, PDF or SVG.",
)  # fmt: skip
@click.option("--singly", is_flag=True, help="Also draw each seed of a group, thin, with its interventions.")
@json_option
def plot(runs: tuple[Path, ...], out: Path, singly: bool, json_file: Path | None) -> None:
    """Draw the learning curves of training runs: average reward per second over 120 s against robot time.

    Runs that differ in nothing but their seed are drawn together, as mean and ± 3 standard errors. Circles are
    interventions, triangles reward drops; what preceded each drop is written into the run's folder.

    \b
    Example:
      openant plot my-ant/runs/sac-* my-ant/runs/sarsa-* --out curves.png
    """
    from openant_tools.cli.learning import need_agents

    need_agents()
    from openant_agents.curves import band, group_runs, plot_groups, read_run_curve
    from openant_agents.drops import write_drops
    from openant_tools.files import json_text, write_text

    curves = [read_run_curve(folder) for folder in runs]
    groups = group_runs(curves)
    plot_groups(groups, out, singly=singly)
    answer = []
    for name, members in groups.items():
        together = band(members)
        last, error = together.mean[-1], together.error[-1]
        spread = f" ± {number(3 * error, decimals=1)} (3 standard errors)" if together.runs > 1 else ""
        helped = sum(len(curve.interventions) for curve in members)
        click.echo(
            f"{name}: {number(last, sign=True, decimals=1)}{spread} cm/s after {number(together.minutes[-1], 'min', decimals=0)},"
            f" {together.runs} {'seeds' if together.runs > 1 else 'seed'}"
            + (f", {helped} intervention{'s' if helped > 1 else ''}" if helped else "")
        )
        answer.append(
            {
                "name": name, "runs": [str(curve.folder) for curve in members],
                "seconds": (60.0 * together.minutes).round(3).tolist(),
                "mean_m_s": (0.01 * together.mean).round(6).tolist(),
                "standard_error_m_s": (0.01 * together.error).round(6).tolist(),
                "interventions": helped,
            }
        )  # fmt: skip
    for curve in curves:
        for drop, path in zip(curve.drops, write_drops(curve.folder, curve.points), strict=True):
            back = (
                "not back yet"
                if drop.until_s is None
                else f"back after {number((drop.until_s - drop.from_s) / 60, 'min', decimals=0)}"
            )
            click.echo(
                f"reward drop in {curve.folder} at {number(drop.from_s / 60, 'min', decimals=0)}: {number(100 * drop.best_m_s, decimals=1)} →"
                f" {number(100 * drop.lowest_m_s, 'cm/s', decimals=1)}, {back}; what preceded it: {path}"
            )
    mention(f"wrote {out}")
    if json_file is not None:
        write_text(json_file, json_text(answer, indent=None))
