"""Sets of robots for the blind benchmark: a folder a robot, with its run tables and its answer, sealed or open."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import tomlkit
from joblib import Parallel, delayed

from openant_tools.blind.answers import committed, read_answers, write_answers
from openant_tools.blind.by_command import is_made, make_by_command, words_of
from openant_tools.blind.commands import Motion, motions
from openant_tools.blind.draw import BATCH, BUS, Answer, Mix, draw_answers
from openant_tools.blind.log import logged
from openant_tools.blind.robot import true_robot
from openant_tools.blind.simulate import simulate
from openant_tools.blind.through_bus import record_through_bus
from openant_tools.errors import BadInput
from openant_tools.files import read_toml, write_text
from openant_tools.recording.tables import write_table
from openant_tools.robot.mjcf import nominal_mjcf
from openant_tools.workers import tied

__all__ = ["SCHEMA", "make_set", "seed_of_commit"]

SCHEMA = "openant.blind/1"
#: robots that are simulated together: enough that array steps cost little beside mechanics
SIDE_BY_SIDE = 20


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
    maker: str | None = None,
    jobs: int = 1,
    progress: Callable[[float, str], None] = lambda share, words: None,
) -> str:
    """Draw robots, simulate them, write their tables; what is there already is kept, so that it can go on.

    Returns:
        The commitment of the answers.

    Args:
        commit: whose hash gave the seed, for the record.
        key: seals the answers; None leaves them open, as `truth.toml` beside the runs.
        answers: in place of what the seed draws.
        maker: of all robots: "batch", "bus" or a command; None: of the two that live here either.
        jobs: processes.

    Raises:
        BadInput: `out` holds something else, or a command cannot be used.
    """
    mix = mix or Mix()
    by = BUS if maker == "bus" else maker
    command = by if by not in (None, BATCH, BUS) else None
    if command is not None:
        words_of(command)
    drawn = list(answers) if answers is not None else draw_answers(count, seed, mix, by)
    played = motions(seed)
    facts: dict[str, Any] = {"robots": len(drawn), "seed": seed}
    if maker is not None:
        facts["maker"] = maker
    commitment, robots = _claim(out, drawn, facts, commit, mix, key)
    write_text(out / "model.xml", nominal_mjcf("standard"))
    if command is not None:
        _make_by_command(out, robots, command, jobs, progress)
        return commitment
    todo = [name for name in robots if not _done(out / name, played)]
    by_batch = [name for name in todo if robots[name].maker == BATCH]
    batches = [by_batch[at : at + SIDE_BY_SIDE] for at in range(0, len(by_batch), SIDE_BY_SIDE)]
    batches += [[name] for name in todo if robots[name].maker == BUS]
    work = (delayed(tied(_make_batch))(out, [(name, robots[name]) for name in batch], played) for batch in batches)
    progress(0.0, "simulating")
    # A robot of the bus takes about as long as a batch of the others.
    for done, _ in enumerate(Parallel(n_jobs=jobs, return_as="generator_unordered")(work), 1):
        progress(done / len(batches), "simulating")
    return commitment


def _make_by_command(
    out: Path, robots: Mapping[str, Answer], command: str, jobs: int, progress: Callable[[float, str], None]
) -> None:
    facts = read_toml(out / "set.toml")
    left_out = list(facts.get("left_out", []))
    todo = [name for name in robots if name not in left_out and not is_made(out / name)]

    def one(name: str) -> tuple[str, bool]:
        return name, make_by_command(command, robots[name], out / name, out / "model.xml")

    progress(0.0, "simulating")
    # Threads: each waits for a process.
    made = Parallel(n_jobs=jobs, prefer="threads", return_as="generator_unordered")(delayed(one)(name) for name in todo)
    for done, (name, could) in enumerate(made, 1):
        if not could:
            left_out.append(name)
            write_text(out / "set.toml", tomlkit.dumps(facts | {"left_out": sorted(left_out)}))
        progress(done / len(todo), "simulating")


def _name(k: int) -> str:
    return f"robot-{k:03d}"


def _done(folder: Path, played: Sequence[Motion]) -> bool:
    return all((folder / f"{motion.name}{suffix}").exists() for motion in played for suffix in (".parquet", ".json"))


def _missing(out: Path, batch: Sequence[tuple[str, Answer]], motion: Motion) -> list[tuple[str, Answer]]:
    return [(name, answer) for name, answer in batch if not _done(out / name, [motion])]


def _claim(
    out: Path, answers: list[Answer], drawn: dict[str, Any], commit: str | None, mix: Mix, key: bytes | None
) -> tuple[str, Mapping[str, Answer]]:
    """Write the set's facts and its answers, or see that it is the same set and take those that it has; their commitment.

    Returns:
        the commitment, and robot → answer.
    """
    facts: dict[str, Any] = {"schema": SCHEMA, **drawn}
    if commit:
        facts["seed_from_commit"] = commit
    facts["mix"] = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(mix).items()}
    # A set that names no maker is another than one that does.
    commitment = committed(out, {"maker": None, **facts})
    if commitment is not None:
        # What was sealed stays true, however a later version of this code would draw.
        return commitment, read_answers(out, key, commitment)
    robots = {_name(k): answer for k, answer in enumerate(answers)}
    facts["commitment"] = write_answers(out, robots, key)
    write_text(out / "set.toml", tomlkit.dumps(facts))
    return str(facts["commitment"]), robots


def _make_batch(out: Path, batch: Sequence[tuple[str, Answer]], played: Sequence[Motion]) -> None:
    if batch[0][1].maker == BUS:
        ((name, answer),) = batch
        record_through_bus(answer, played, lambda motion, run: write_table(run, out / name / f"{motion.name}.parquet"))
        return
    for number, motion in enumerate(played):
        todo = _missing(out, batch, motion)
        robots = [true_robot(answer) for _, answer in todo]
        for (name, _), robot, trace in zip(todo, robots, simulate(robots, motion, number) if todo else (), strict=True):
            write_table(logged(robot, motion, number, trace), out / name / f"{motion.name}.parquet")
