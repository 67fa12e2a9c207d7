"""Recordings and training runs as a Minari dataset, for offline learning: Minari's own layout with its `parquet` storage."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.exchange.card import card
from openant_tools.exchange.source import Source, read_source
from openant_tools.files import atomic_writer, json_text, read_json, write_text
from openant_tools.optional import pa, pq
from openant_tools.recording.run import BODY_COLUMNS, Array
from openant_tools.robot.folder import RobotFolder

__all__ = ["write_minari"]

#: whose layout this is
MINARI = "0.5.4"
TRAINED = "openant.train/1"
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class MinariEpisode:
    """(n + 1) observations and n steps: (n, actions), (n,) rewards, and whether the last one ended the task."""

    observations: Floats
    actions: Floats
    rewards: Array
    terminated: bool


@dataclass(frozen=True)
class Names:
    """What each number of an observation and of an action is; the bounds (actions, 2) of the latter."""

    observations: tuple[str, ...]
    actions: tuple[str, ...]
    bounds: Floats


def write_minari(paths: Sequence[Path], out: Path) -> tuple[int, int]:
    """Write runs, or folders of training runs, as one dataset into `out`; returns how many episodes and steps it has.

    Of a recording an observation is what was measured when a command was sent (joint positions and velocities, IMU, tracker;
    SI), an action is the command in rad, and the reward how far the body came along x by the next one, m: NaN without a
    tracker. Of a training run (SAC) all three are the agent's own.

    Raises:
        BadInput: a run cannot be used, or is of other numbers than the first; there is a dataset already.
    """
    if (out / "data" / "metadata.json").exists():
        raise BadInput("there is a dataset already", where=out, remedy="name another folder with --out")
    episodes: list[MinariEpisode] = []
    names: Names | None = None
    runs, notes, folder = [], list[str](), None
    for path in paths:
        found, here, own, said = _trained(path) if (path / "run.json").is_file() else _recorded(path)
        if names is not None and (here.observations, here.actions) != (names.observations, names.actions):
            raise BadInput(
                "its observations or actions are others than those of the first run",
                where=path,
                remedy="export runs of one kind together",
            )
        if names is not None:
            low, high = np.minimum(names.bounds, here.bounds)[:, 0], np.maximum(names.bounds, here.bounds)[:, 1]
            here = replace(here, bounds=np.array([low, high]).T)
        names, folder = here, folder or own
        episodes += found
        runs.append(f"`{path.name}`: {len(found)} episodes, {sum(len(one.rewards) for one in found)} steps")
        notes += [f"`{path.name}`: {line}" for line in said]
    assert names is not None
    steps = sum(len(one.rewards) for one in episodes)
    for number, episode in enumerate(episodes):
        _write(out / "data" / str(number), number, episode)
    wide = np.full(len(names.observations), np.inf)
    size = sum(file.stat().st_size for file in (out / "data").rglob("*.parquet")) / 1e6
    metadata = {
        "total_episodes": len(episodes), "total_steps": steps, "data_format": "parquet", "jpeg_encoding": True,
        "observation_space": _box(-wide, wide), "action_space": _box(*names.bounds.T), "dataset_id": f"openant/{out.name}-v0",
        "minari_version": MINARI, "dataset_size": round(size, 1), "description": "Open Ant; see README.md",
        "observation_names": names.observations, "action_names": names.actions,
    }  # fmt: skip
    write_text(out / "data" / "metadata.json", json_text(metadata))
    write_text(out / "README.md", card(f"{out.name}, a Minari dataset", folder, runs, notes))
    return len(episodes), steps


def _box(low: Array, high: Array) -> str:
    space = {"type": "Box", "dtype": "float32", "shape": [len(low)], "low": low.tolist(), "high": high.tolist()}
    return json.dumps(space)  # Python's own: infinities are words there, as Minari reads them


def _write(folder: Path, number: int, episode: MinariEpisode) -> None:
    """Steps stand with the observation before them; the last observation has a row of its own, padded."""
    n = len(episode.rewards)

    def padded(values: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([values, np.zeros((1, *values.shape[1:]), values.dtype)])

    def lists(values: Floats) -> Any:
        return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])

    ends = np.arange(n) == n - 1
    table = pa.table(
        {
            "observations": lists(episode.observations), "actions": lists(padded(episode.actions)),
            "rewards": padded(episode.rewards), "terminations": padded(ends & episode.terminated),
            "truncations": padded(ends & (not episode.terminated)),
        }
    )  # fmt: skip
    with atomic_writer(folder / "part-0.parquet") as stream:
        pq.write_table(table, stream, row_group_size=len(table))
    write_text(folder / "metadata.json", json_text({"id": number, "total_steps": n}))


Found = tuple[list[MinariEpisode], Names, RobotFolder | None, list[str]]


def _recorded(path: Path) -> Found:
    source = read_source(path, draw=False)
    run = source.run
    if not run.has("cmd") or not run.has("pos"):
        raise BadInput("it has no commands, or no positions", where=path, remedy="export a run that moved the robot")
    rows = _decisions(source)
    if len(rows) < 2:
        raise BadInput("nothing was commanded twice in it", where=path, remedy="export a run that moved the robot")
    columns = [f"{signal}.{joint}" for signal in ("pos", "vel") if run.has(signal) for joint in run.joints]
    columns += [name for name in BODY_COLUMNS if name in run.columns and "." in name]
    seen = np.array([_known(np.asarray(run.columns[name], float)) for name in columns]).T[rows]
    actions = np.array([_known(run.column(f"cmd.{joint}")) for joint in run.joints]).T[rows]
    along = _known(run.column("base.x"))[rows] if "base.x" in run.columns else np.full(len(rows), math.nan)
    low, high = actions.min(axis=0), actions.max(axis=0)
    names = Names(tuple(columns), tuple(f"cmd.{joint}" for joint in run.joints), np.array([low, high], np.float32).T)
    said = ["the reward is how far the body came along x, m, not that of a task"]
    said += [] if np.isfinite(along).all() else ["no tracker saw the body: rewards are NaN"]
    said.append("where a sample was missing, the one before stands")
    episode = MinariEpisode(seen.astype(np.float32), actions[:-1].astype(np.float32), np.diff(along), False)
    return [episode], names, source.folder, said


def _decisions(source: Source) -> NDArray[np.int64]:
    """The rows in which a command left: those of an agent's actions, where it said which."""
    run = source.run
    acted = np.flatnonzero(np.isfinite(run.column("act_t")))
    if len(acted):
        return acted
    sent = run.column("cmd_t")
    if np.isfinite(sent).any():
        return np.flatnonzero(np.isfinite(sent) & (np.diff(sent, prepend=-np.inf) > 0))
    return np.arange(len(run.t))


def _known(values: Array) -> Array:
    """The last finite value in place of NaN; the first one before it, and 0 where there is none."""
    there = np.flatnonzero(np.isfinite(values))
    if not len(there):
        return np.zeros(len(values))
    return np.asarray(values[there[np.clip(np.searchsorted(there, np.arange(len(values)), "right") - 1, 0, None)]])


def _trained(folder: Path) -> Found:
    facts = read_json(folder / "run.json")
    if not isinstance(facts, dict) or facts.get("schema") != TRAINED:
        raise BadInput("this is no training run", where=folder, remedy="name a folder that `openant train` made")
    if facts.get("agent") != "sac":
        raise BadInput(
            "a run of SARSA(λ) holds primitives, not commands", where=folder, remedy="export runs of SAC, or recordings"
        )
    o, a = int(facts["observations"]), int(facts["actions"])
    rows = np.fromfile(folder / "transitions.f32", np.float32)
    rows = rows[: len(rows) // (2 * o + a + 3) * (2 * o + a + 3)].reshape(-1, 2 * o + a + 3)
    if not len(rows):
        raise BadInput("it has made no step yet", where=folder, remedy="train longer")
    trained_on = facts.get("trained_on", {})
    names = Names(
        tuple(trained_on.get("observation_names") or (str(k) for k in range(o))),
        tuple(trained_on.get("action_names") or (str(k) for k in range(a))),
        np.tile(np.array([-1.0, 1.0], np.float32), (a, 1)),
    )
    robot = _folder_of(facts)
    return list(_episodes(rows, o, a)), names, robot, [f"actions of −1…1 are of {trained_on.get('action_range')}"]


def _episodes(rows: Floats, o: int, a: int) -> Iterator[MinariEpisode]:
    """Cut where a step does not begin where the one before ended: someone helped, or the task began anew."""
    seen, after, ended = rows[:, :o], rows[:, o + a + 3 :], rows[:, o + a + 2] > 0
    cuts = np.flatnonzero((seen[1:] != after[:-1]).any(axis=1) | ended[:-1]) + 1
    for part in np.split(np.arange(len(rows)), cuts):
        observations = np.concatenate([seen[part], after[part[-1:]]])
        yield MinariEpisode(observations, rows[part, o : o + a], rows[part, o + a].astype(float), bool(ended[part[-1]]))


def _folder_of(facts: Mapping[str, Any]) -> RobotFolder | None:
    named = facts.get("env", {}).get("options", {}).get("robot")
    place = Path(str(named)) if named else None
    return RobotFolder.at(place) if place is not None and (place / "robot.toml").is_file() else None
