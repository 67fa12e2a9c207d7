"""A LeRobot dataset becomes runs, one an episode: `observation.state` what was measured, `action` what was commanded."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.exchange.lerobot_dataset import ACTION, STATE, DatasetFacts, episodes, open_dataset
from openant_tools.exchange.lerobot_units import (
    RESOLUTION_RAD,
    MotorRange,
    SeenRange,
    Unit,
    UnitScale,
    joint_scale,
    joint_units,
    read_calibration,
)
from openant_tools.numbers import literal, number, percent
from openant_tools.recording.plausibility import LIMITS
from openant_tools.recording.run import Facts, Run

__all__ = ["DatasetConversion", "convert", "read_conversion"]

#: share of rows at an end of the range from which it is said that positions were cut off there
CUT_OFF = 0.01
CALIBRATION = "~/.cache/huggingface/lerobot/calibration/robots/KIND/ID.json"


@dataclass(frozen=True)
class ImportedJoint:
    """One joint of a dataset: our name, where its numbers stand in `observation.state` and in `action`, what they are."""

    name: str
    state: int
    action: int
    scale: UnitScale


@dataclass(frozen=True)
class DatasetConversion:
    """How a dataset is read.

    Attributes:
        whole: whether positions are whole counts of servos.
        remarks: what was supposed, and what was left out, a line each.
    """

    dataset: DatasetFacts
    joints: tuple[ImportedJoint, ...]
    whole: bool
    remarks: tuple[str, ...]


def read_conversion(
    root: Path, calibration: Path | None = None, rename: Mapping[str, str] | None = None, unit: Unit | None = None
) -> DatasetConversion:
    """Read the dataset in `root` once, check every row, and tell how its numbers become angles.

    Args:
        calibration: the robot's, as LeRobot wrote it; normalised units and grippers need it.
        rename: their joint → ours. unit: of all but grippers; default: what the numbers show.

    Raises:
        BadInput: the dataset, the calibration or a name cannot be used; the line says which and why.
        OSError: a file cannot be read.
    """
    dataset = open_dataset(root)
    where = str(root)
    measured, commanded = _joints(dataset.state), _joints(dataset.action)
    both = [joint for joint in measured if joint in commanded]
    if not both:
        raise BadInput(
            f"no joint is in {STATE} ({_few(dataset.state)}) and in {ACTION} ({_few(dataset.action)})",
            where=where,
            remedy="a joint is called alike in both, as in shoulder_pan.pos",
        )
    names = _renamed(both, rename or {}, where)
    spans = _spans(both, calibration)
    seen = {joint: SeenRange("gripper" in joint.lower()) for joint in both}
    for episode in episodes(dataset):
        for joint, one in seen.items():
            one.add(episode.state[:, measured[joint]], episode.action[:, commanded[joint]])
    if not seen[both[0]].rows:
        raise BadInput("there are no rows", where=where, remedy="record an episode")
    try:
        units, certain = joint_units(seen, spans, dataset.robot, unit)
    except BadInput as error:
        raise BadInput(error.what, where=where, remedy=error.remedy) from None
    scales = {joint: joint_scale(units[joint], spans[joint], dataset.robot) for joint in both}
    without = [joint for joint, scale in scales.items() if scale is None]
    if len(without) == len(both) or any(units[joint] == "normalised" for joint in without):
        raise BadInput(
            f"{_few(without)} in normalised units: no angles without the robot's calibration",
            where=where,
            remedy=f"add --calibration FILE ({CALIBRATION})",
        )
    joints = []
    for joint, scale in scales.items():
        if scale is None:
            continue
        farthest = float(np.abs(scale(np.array([seen[joint].low, seen[joint].high]))).max())
        if farthest > LIMITS["pos"].high:
            raise BadInput(
                f"{joint}, read in {units[joint]}, reaches {number(farthest, 'rad')}",
                where=where,
                remedy="an angle lies within four turns: say what it is in with --units, or mend the dataset",
            )
        joints.append(ImportedJoint(names[joint], measured[joint], commanded[joint], scale))
    wholes = {joint: seen[joint].whole(units[joint], spans[joint]) for joint in both}
    return DatasetConversion(
        dataset,
        tuple(joints),
        True in wholes.values() and False not in wholes.values(),
        tuple(_remarks(dataset, both, without, seen, units, certain, wholes, calibration)),
    )


def convert(conversion: DatasetConversion) -> Iterator[Run]:
    """The dataset's episodes as runs `episode_000`, …, in SI units."""
    dataset = conversion.dataset
    names = tuple(joint.name for joint in conversion.joints)
    for episode in episodes(dataset):
        columns: dict[str, Any] = {}
        for joint in conversion.joints:
            columns[f"cmd.{joint.name}"] = joint.scale(episode.action[:, joint.action])
            columns[f"pos.{joint.name}"] = joint.scale(episode.state[:, joint.state])
        notes = [f"episode {episode.index} of the LeRobot dataset {dataset.root.resolve().name}"]
        if dataset.tasks.get(episode.index):
            notes.append(dataset.tasks[episode.index])
        if episode.counted:
            notes.append(f"t is the frame over {literal(dataset.fps)} per s, not when a row was taken")
        facts = Facts(names, resolution={"pos": RESOLUTION_RAD} if conversion.whole else {}, notes="; ".join(notes))
        yield Run(f"episode_{episode.index:03d}", facts, episode.t, columns)


def _joints(names: Iterable[str]) -> dict[str, int]:
    """Joint → its place among the names of LeRobot (`shoulder_pan.pos`, formerly `shoulder_pan`); all other numbers left out."""
    joints = {name.removesuffix(".pos"): place for place, name in enumerate(names)}
    return {joint: place for joint, place in joints.items() if "." not in joint and joint.isprintable()}


def _renamed(joints: list[str], rename: Mapping[str, str], where: str) -> dict[str, str]:
    names = {joint: joint for joint in joints}
    for theirs, ours in rename.items():
        joint = theirs.removesuffix(".pos")
        if joint not in names:
            near = difflib.get_close_matches(joint, joints, n=1, cutoff=0.6)
            raise BadInput(
                f"--joints: the dataset has no joint {theirs}",
                where=where,
                remedy=f"did you mean {near[0]}?" if near else f"it has {_few(joints)}",
            )
        names[joint] = ours
    twice = sorted({name for name in names.values() if list(names.values()).count(name) > 1})
    if twice:
        raise BadInput(f"--joints: two joints are called {twice[0]}", where=where, remedy="give each a name of its own")
    return names


def _spans(joints: list[str], calibration: Path | None) -> dict[str, MotorRange | None]:
    if calibration is None:
        return dict.fromkeys(joints)
    ranges = read_calibration(calibration)
    for joint in joints:
        if joint not in ranges:
            raise BadInput(
                f"there is no joint {joint}, which the dataset has",
                where=calibration,
                remedy=f"it has {_few(ranges)}: give the calibration of the robot that was recorded",
            )
    return {joint: ranges[joint] for joint in joints}


def _remarks(
    dataset: DatasetFacts,
    both: list[str],
    without: list[str],
    seen: Mapping[str, SeenRange],
    units: Mapping[str, Unit],
    certain: bool,
    wholes: Mapping[str, bool | None],
    calibration: Path | None,
) -> Iterator[str]:
    unit = next((one for one in units.values() if one != "percent"), "percent")
    words = "normalised units" if unit == "normalised" else unit
    if certain:
        yield f"joints are in {words}"
    else:
        why = "their positions are no whole counts" if False in wholes.values() else "that is not certain"
        yield f"joints are taken to be in {words}, but {why} → --calibration FILE or --units, if they are in another"
    others = [name for name in dict.fromkeys(dataset.state + dataset.action) if name.removesuffix(".pos") not in both]
    if others:
        yield f"left out, no joint's position and command: {_few(others)}"
    if without:
        yield f"left out, in percent of a range: {_few(without)} → --calibration FILE makes angles of it"
    off = [joint for joint, whole in wholes.items() if whole is False]
    if calibration is not None and off and unit != "radians":
        yield f"positions of {_few(off)} are no whole counts by {calibration.name} → is it of this robot, and of that day?"
    for joint, one in seen.items():
        if units[joint] in ("normalised", "percent") and joint not in without and one.at_end > CUT_OFF * one.rows:
            yield (
                f"{joint} is at an end of its calibrated range in {percent(one.at_end / one.rows)} of rows: LeRobot cuts "
                "positions off there"
            )


def _few(names: Iterable[str], count: int = 8) -> str:
    names = list(names)
    return ", ".join(names[:count]) + (", …" if len(names) > count else "")
