"""A training run on disk: what was asked for, checkpoints, transitions and the learning curve.

    run.json             what is trained, on what, with which settings and seed
    checkpoint.pt        networks, optimisers, random states, counters and the simulation's state
    transitions.f32      every transition, rows of float32 in the order of the replay buffer, appended
    learning_curve.csv   step, seconds, average_reward_m_s, appended
    learning_curve.png   the same as a picture
    interventions.csv    step, seconds, reason: where someone or something had to help

A checkpoint replaces the last one in one stroke, after the transitions and the curve that belong to it are on the disk;
it says how long both files were. Whatever a killed process had appended beyond is cut off on resuming, so that a
resumed run goes on as if it had never been stopped. One process at a time trains in a folder: it holds a lock there
(`openant_tools.lock`), which ends with it, however it ends. Where learning runs beside acting, transitions stand in the file as
soon as they are made, and a run goes on with all of them, those after the last checkpoint included.
"""

from __future__ import annotations

import csv
import errno
import io
import json
import math
import os
import zipfile
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.files import json_text, read_json, read_text, reading, write_bytes, write_text
from openant_tools.lock import Claim

__all__ = [
    "SCHEMA",
    "CurvePoint",
    "TrainingRun",
    "check_free",
    "has_checkpoint",
    "load_checkpoint",
    "making_sense",
    "read_curve",
    "read_facts",
    "save_checkpoint",
]

SCHEMA = "openant.train/1"
LOCK = ".run.lock"
CURVE_COLUMNS = ("step", "seconds", "average_reward_m_s")
INTERVENTION_COLUMNS = ("step", "seconds", "reason")


@dataclass(frozen=True)
class CurvePoint:
    """One row of a learning curve.

    Attributes:
        step: environment steps so far.
        seconds: s, robot time so far.
        average_reward_m_s: m/s, over the last 120 s.
    """

    step: int
    seconds: float
    average_reward_m_s: float


class TrainingRun:
    """The folder of one training run.

    Args:
        folder: made where it is missing.
        facts: what `run.json` says; a folder that holds a run goes on only if its facts are the same.

    Raises:
        BadInput: the folder holds another run, or files that are none, or another process trains in it.
        OSError: it cannot be written.
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        self.folder = folder
        # As it will be read back: tuples as lists, keys as texts.
        self.facts: dict[str, Any] = json.loads(json_text({"schema": SCHEMA, **facts}))
        self._claim = _claim(folder)
        path = folder / "run.json"
        try:
            if path.is_file():
                _check_same(path, read_facts(folder), self.facts)
            else:
                write_text(path, json_text(self.facts, indent=2))
        except BaseException:
            self._claim.release()
            raise
        self._saved_rows = 0
        self._curve: io.TextIOWrapper | None = None
        self._log: io.FileIO | None = None

    def resume(self) -> dict[str, Any] | None:
        """The last checkpoint, with the curve and the transitions cut back to it; None where there is none yet."""
        path = self.folder / "checkpoint.pt"
        checkpoint = load_checkpoint(self.folder) if path.is_file() else None
        curve_bytes = 0 if checkpoint is None else int(checkpoint["curve_bytes"])
        self._saved_rows = 0 if checkpoint is None else int(checkpoint["transitions"])
        self._cut(self.folder / "learning_curve.csv", curve_bytes)
        if checkpoint is not None:
            self._cut(self.folder / "transitions.f32", self._saved_rows * int(checkpoint["transition_bytes"]))
        else:
            (self.folder / "transitions.f32").unlink(missing_ok=True)
        curve = (self.folder / "learning_curve.csv").open("a", encoding="utf-8", newline="")
        self._curve = curve
        if curve_bytes == 0:
            curve.write(",".join(CURVE_COLUMNS) + "\n")
            curve.flush()
        self._cut_interventions(0 if checkpoint is None else int(checkpoint["step"]))
        return checkpoint

    def go_on(self, width: int) -> tuple[dict[str, Any] | None, NDArray[np.float32]]:
        """The last checkpoint, if there is one, and every transition that was ever appended, (rows, width).

        For a run that is learned beside acting: nothing is cut back but what a kill left half written.
        """
        path = self.folder / "checkpoint.pt"
        checkpoint = load_checkpoint(self.folder) if path.is_file() else None
        log = self.folder / "transitions.f32"
        rows = log.stat().st_size // (4 * width) if log.is_file() else 0
        known = 0 if checkpoint is None else int(checkpoint["transitions"])
        self._cut(log, max(rows, known) * 4 * width)
        self._log = log.open("ab", buffering=0)
        curve = self.folder / "learning_curve.csv"
        text = curve.read_bytes() if curve.is_file() else b""
        self._cut(curve, text.rfind(b"\n") + 1)
        self._curve = curve.open("a", encoding="utf-8", newline="")
        if not text:
            self._curve.write(",".join(CURVE_COLUMNS) + "\n")
            self._curve.flush()
        return checkpoint, np.fromfile(log, np.float32).reshape(-1, width)

    def append(self, row: NDArray[np.float32]) -> None:
        """Put one transition, (width,), at the end of the file, where a kill no longer reaches it."""
        assert self._log is not None
        data = row.tobytes()
        if self._log.write(data) != len(data):
            # A part of it took the last of the disk; it is cut off where the run goes on.
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.folder / "transitions.f32"))

    def _cut_interventions(self, step: int) -> None:
        path = self.folder / "interventions.csv"
        if not path.is_file():
            return
        with path.open(encoding="utf-8", newline="") as stream:
            rows = [row for row in csv.reader(stream) if row and (not row[0].isdigit() or int(row[0]) <= step)]
        text = io.StringIO(newline="")
        csv.writer(text).writerows(rows)
        write_text(path, text.getvalue())

    def add_intervention(self, step: int, seconds: float, reason: str) -> None:
        """Note that someone or something had to help, and why."""
        path = self.folder / "interventions.csv"
        new = not path.is_file()
        with path.open("a", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            if new:
                writer.writerow(INTERVENTION_COLUMNS)
            writer.writerow((step, f"{seconds:.3f}", reason))  # for a file

    def _cut(self, path: Path, size: int) -> None:
        if size == 0:
            path.unlink(missing_ok=True)
            return
        there = path.stat().st_size if path.is_file() else 0
        if there < size:
            raise BadInput(
                f"it has {there} bytes of the {size} that its checkpoint speaks of",
                where=path,
                remedy="train into another folder; this one has lost data",
            )
        os.truncate(path, size)

    def transitions(self, width: int, newest: int) -> NDArray[np.float32]:
        """The last `newest` saved transitions, (rows, width), oldest first."""
        rows = min(self._saved_rows, newest)
        if rows == 0:
            return np.empty((0, width), np.float32)
        skip = (self._saved_rows - rows) * width * 4
        return np.fromfile(self.folder / "transitions.f32", np.float32, rows * width, offset=skip).reshape(rows, width)

    def save(self, state: Mapping[str, Any], new_transitions: NDArray[np.float32]) -> None:
        """Put a checkpoint on the disk, so that a crash at any instant finds this one or the one before it whole.

        Args:
            state: tensors, numbers, texts, lists and dictionaries.
            new_transitions: (rows, width), those added since the last checkpoint.
        """
        with (self.folder / "transitions.f32").open("ab") as stream:
            stream.write(np.ascontiguousarray(new_transitions).tobytes())
            stream.flush()
            os.fsync(stream.fileno())
        self._saved_rows += len(new_transitions)
        assert self._curve is not None
        self._curve.flush()
        os.fsync(self._curve.fileno())
        save_checkpoint(self.folder, state, self._saved_rows, new_transitions.shape[1], self._curve.tell())

    def add_curve_point(self, point: CurvePoint) -> None:
        assert self._curve is not None
        self._curve.write(f"{point.step},{point.seconds:.3f},{point.average_reward_m_s:.6f}\n")  # for a file
        self._curve.flush()

    def close(self) -> None:
        for stream in (self._curve, self._log):
            if stream is not None:
                stream.close()
        self._curve = self._log = None
        self._claim.release()


def save_checkpoint(folder: Path, state: Mapping[str, Any], transitions: int, width: int, curve_bytes: int) -> None:
    """Replace a run's checkpoint in one stroke.

    Args:
        state: tensors, numbers, texts, lists and dictionaries.
        transitions: how many rows of the file belong to it, of `width` numbers each; they are on the disk already.
        curve_bytes: how much of the learning curve belongs to it.
    """
    whole = {
        **state, "schema": SCHEMA, "transitions": transitions, "transition_bytes": width * 4, "curve_bytes": curve_bytes
    }  # fmt: skip
    import torch  # seconds to load, and who reads curves or facts needs none of it

    buffer = io.BytesIO()
    torch.save(_plain(whole), buffer)
    write_bytes(folder / "checkpoint.pt", buffer.getvalue())


def read_facts(folder: Path) -> dict[str, Any]:
    """What `run.json` says.

    Raises:
        BadInput: the folder holds no training run.
    """
    path = folder / "run.json"
    if not path.is_file():
        raise BadInput(
            "there is no training run here (no run.json)", where=folder, remedy="name the --out of `openant train`"
        )
    facts = read_json(path, "train into another folder")
    if not isinstance(facts, dict) or facts.get("schema") != SCHEMA:
        raise BadInput(f"its schema is not {SCHEMA}", where=path, remedy="train into another folder")
    return facts


def has_checkpoint(folder: Path) -> bool:
    """Whether a run was ever saved."""
    return (folder / "checkpoint.pt").is_file()


def load_checkpoint(folder: Path) -> dict[str, Any]:
    """The checkpoint of a run; nothing in the file is executed.

    Raises:
        BadInput: there is none, or it cannot be read.
    """
    import torch

    path = folder / "checkpoint.pt"
    if not path.is_file():
        raise BadInput("there is no checkpoint yet", where=folder, remedy="train a little longer (`openant train sac`)")
    try:
        with zipfile.ZipFile(path) as archive:  # older forms of torch's files are none of ours, nor compressed ones
            if sum(entry.file_size for entry in archive.infolist()) > path.stat().st_size:
                raise ValueError("it is compressed")
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises a dozen kinds for a file that is cut, foreign or not a zip at all
        raise BadInput(
            "the checkpoint cannot be read; the file is damaged or none of ours",
            where=path,
            remedy="train into another folder, or put a copy of it back",
        ) from error
    if not isinstance(checkpoint, dict) or checkpoint.get("schema") != SCHEMA:
        raise BadInput(f"the checkpoint's schema is not {SCHEMA}", where=path, remedy="train into another folder")
    return checkpoint


def making_sense(folder: Path) -> AbstractContextManager[None]:
    """A block that takes a run up from what it saved: what is missing or of another kind there is one line, BadInput."""
    return reading(
        folder / "checkpoint.pt",
        "the checkpoint is not as its run.json and this program have it",
        "train into another folder",
    )


def read_curve(folder: Path) -> list[CurvePoint]:
    """The learning curve of a run.

    Raises:
        BadInput: there is none, or a row of it is not what it should be.
    """
    path = folder / "learning_curve.csv"
    if not path.is_file():
        raise BadInput("there is no learning curve here", where=folder, remedy="name the --out of `openant train`")
    points: list[CurvePoint] = []
    with reading(path, "it is no learning curve", "name the --out of `openant train`"):
        rows = list(csv.DictReader(io.StringIO(read_text(path))))
        for number, row in enumerate(rows, 2):
            try:
                point = CurvePoint(int(row["step"]), float(row["seconds"]), float(row["average_reward_m_s"]))
            except (KeyError, TypeError, ValueError):
                if number == len(rows) + 1:
                    break  # the last line of a run that was killed while writing it
                raise BadInput(
                    f"row {number} is not {', '.join(CURVE_COLUMNS)}", where=path, remedy="repair the row"
                ) from None
            if math.isfinite(point.average_reward_m_s):
                points.append(point)
    return points


def check_free(folder: Path, facts: Mapping[str, Any]) -> None:
    """Refuse a folder that holds another run, or in which another process trains, as far as is known before a robot is asked.

    Args:
        facts: some of what `run.json` is to say.

    Raises:
        BadInput: as `TrainingRun`.
    """
    path = folder / "run.json"
    if path.is_file():
        _claim(folder).release()
        there, asked = read_facts(folder), json.loads(json_text(facts))
        _check_same(path, {name: there.get(name) for name in asked}, asked)


def _claim(folder: Path) -> Claim:
    return Claim(
        folder / LOCK,
        "another process trains in this folder: {}",
        remedy="wait for it, stop it, or name another --out",
    )


def _check_same(path: Path, there: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """A run goes on only as what it was begun as; versions of libraries may differ."""
    differing = sorted(
        f"{key} ({_short(old.get(key))}, not {_short(new.get(key))})"
        for old, new in [(_flat(there), _flat(asked))]
        for key in old.keys() | new.keys()
        if not key.startswith("versions") and old.get(key) != new.get(key)
    )
    if differing:
        raise BadInput(
            f"this folder holds another run: it differs in {', '.join(differing[:4])}",
            where=path.parent,
            remedy="name another --out, or repeat the command that began it",
        )


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "…"


def _flat(facts: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in facts.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _plain(value: Any) -> Any:
    """The same with arrays as tensors and NumPy's numbers as Python's, so that it loads without running any code."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        import torch

        return torch.from_numpy(value.copy())
    if isinstance(value, np.generic):
        return value.item()
    return value
