"""Sets of robots for the blind benchmark: a folder a robot, with its run tables and its answer, sealed or open."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import tomlkit
from joblib import Parallel, delayed

from openant_tools.blind.answers import committed, read_answers, write_answers
from openant_tools.blind.commands import Motion, motions
from openant_tools.blind.draw import Answer, Mix, draw_answers
from openant_tools.blind.log import logged
from openant_tools.blind.robot import true_robot
from openant_tools.blind.simulate import simulate
from openant_tools.blind.through_bus import record_through_bus
from openant_tools.errors import BadInput
from openant_tools.files import write_text
from openant_tools.recording.tables import write_table
from openant_tools.robot.mjcf import nominal_mjcf
from openant_tools.workers import tied

__all__ = ["SCHEMA", "make_set", "seed_of_commit"]

SCHEMA = "openant.blind/1"
#: robots that are simulated together: enough that array steps cost little beside mechanics
BATCH = 20


def seed_of_commit(commit: str, folder: Path | None = None) -> tuple[int, str]:
    """The seed that a commit gives, and its full hash: nobody chose it, and anybody can check it.

    Raises:
        BadInput: there is no such commit here.
    """
    done = subprocess.run(
        ["git", "rev-parse", "--verify", f"{commit}^{{commit}}"],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
    )
    if done.returncode:
        raise BadInput(
            f"there is no commit {commit!r} here", remedy="run it in the repository, or give --seed a number"
        )
    full = done.stdout.strip()
    return int(full[:8], 16), full


def make_set(
    out: Path,
    count: int,
    seed: int,
    *,
    mix: Mix | None = None,
    commit: str | None = None,
    key: bytes | None = None,
    answers: Sequence[Answer] | None = None,
    motion_seed: int | None = None,
    jobs: int = 1,
    progress: Callable[[str, float], None] = lambda words, share: None,
) -> str:
    """Draw robots, simulate them, write their tables; what is there already is kept, so that it can go on.

    Returns:
        The commitment of the answers.

    Args:
        commit: whose hash gave the seed, for the record.
        key: seals the answers; None leaves them open, as `truth.toml` beside the runs.
        answers: in place of what the seed draws.
        motion_seed: of the commands, where it is not to be the set's: sets of one protocol can share what was prepared.
        jobs: processes.

    Raises:
        BadInput: `out` holds something else.
    """
    mix = mix or Mix()
    drawn = list(answers) if answers is not None else draw_answers(count, seed, mix)
    motion_seed = seed if motion_seed is None else motion_seed
    played = motions(motion_seed)
    facts = {"robots": len(drawn), "seed": seed, "motion_seed": motion_seed}
    commitment, drawn = _claim(out, drawn, facts, commit, mix, key)
    write_text(out / "model.xml", nominal_mjcf("standard"))
    todo = [k for k in range(len(drawn)) if not _done(out / _name(k), played)]
    by_batch = [k for k in todo if drawn[k].maker == "batch"]
    batches = [by_batch[at : at + BATCH] for at in range(0, len(by_batch), BATCH)]
    batches += [[k] for k in todo if drawn[k].maker == "virtual"]
    work = (delayed(tied(_make_batch))(out, [(k, drawn[k]) for k in batch], played) for batch in batches)
    progress("simulating", 0.0)
    # A robot of the bus takes about as long as a batch of the others.
    for done, _ in enumerate(Parallel(n_jobs=jobs, return_as="generator_unordered")(work), 1):
        progress("simulating", done / len(batches))
    return commitment


def _name(k: int) -> str:
    return f"robot-{k:03d}"


def _done(folder: Path, played: Sequence[Motion]) -> bool:
    return all((folder / f"{motion.name}{suffix}").exists() for motion in played for suffix in (".parquet", ".json"))


def _missing(out: Path, batch: Sequence[tuple[int, Answer]], motion: Motion) -> list[tuple[int, Answer]]:
    return [(k, answer) for k, answer in batch if not _done(out / _name(k), [motion])]


def _claim(
    out: Path, answers: list[Answer], drawn: dict[str, int], commit: str | None, mix: Mix, key: bytes | None
) -> tuple[str, list[Answer]]:
    """Write the set's facts and its answers, or see that it is the same set and take those that it has; their commitment."""
    facts: dict[str, Any] = {"schema": SCHEMA, **drawn}
    if commit:
        facts["seed_from_commit"] = commit
    facts["mix"] = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(mix).items()}
    commitment = committed(out, facts)
    if commitment is not None:
        # What was sealed stays true, however a later version of this code would draw.
        return commitment, list(read_answers(out, key, commitment).values())
    facts["commitment"] = write_answers(out, [_name(k) for k in range(len(answers))], answers, key)
    write_text(out / "set.toml", tomlkit.dumps(facts))
    return str(facts["commitment"]), answers


def _make_batch(out: Path, batch: Sequence[tuple[int, Answer]], played: Sequence[Motion]) -> None:
    if batch[0][1].maker == "virtual":
        ((k, answer),) = batch
        record_through_bus(
            answer, played, lambda motion, run: write_table(run, out / _name(k) / f"{motion.name}.parquet")
        )
        return
    for number, motion in enumerate(played):
        todo = _missing(out, batch, motion)
        robots = [true_robot(answer) for _, answer in todo]
        for (k, _), robot, trace in zip(todo, robots, simulate(robots, motion, number) if todo else (), strict=True):
            write_table(logged(robot, motion, number, trace), out / _name(k) / f"{motion.name}.parquet")
