"""What a fit leaves behind: `calibrated.xml`, `fit.json`, `report.html`, and the entries of `robot.toml`."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.effects.catalogue import effect
from openant_tools.effects.entries import as_toml, entries_of
from openant_tools.errors import BadInput
from openant_tools.files import json_text, read_json, write_text
from openant_tools.model.gap import HORIZON_S
from openant_tools.model.mjcf import write_model
from openant_tools.numbers import exact, number, stored
from openant_tools.robot.config import EffectEntry, Provenance
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.pair import PLAIN, mark_of
from openant_tools.sysid.effect_fit import TRIED, better, chosen_in_turn
from openant_tools.sysid.fit_report import fit_report
from openant_tools.sysid.identify import Identification, calibrated, restated
from openant_tools.sysid.kinds import KINDS, said
from openant_tools.sysid.parameter import names_of

__all__ = ["WITH_EFFECTS", "effects_beside", "pair_of", "pairs", "stating_both", "write_fit", "write_robot"]

CALIBRATED = "calibrated.xml"
#: beside it: what MuJoCo has no feature for
EFFECTS = "calibrated.effects.toml"
#: the folder beside it for the fit that is better with effects than any without
WITH_EFFECTS = "with-effects"


def write_fit(result: Identification, out: Path) -> list[Path]:
    """Write the model, the figures and the report into `out`, together or not at all; returns what was written.

    Where nothing was accepted the model is the given one, so that a script can go on with `calibrated.xml` either way. What is
    better with effects that plain MuJoCo cannot play goes into a folder of its own within.
    """
    richer = result.with_effects
    more = {"pairs": pairs(result, richer)} if richer else {}
    runs = ", ".join(run.name for data in result.datasets for run in data.runs)

    def note(given: Path) -> str:
        return f"Calibrated by `openant sysid fit` on {datetime.date.today()} from {given.name} and {runs}"

    word = pair_of(result)
    entries = [replace(entry, pair=word) for entry in entries_of(result.effects, result.joints)]
    models, earlier = result.models, _written_before(out)
    written = _models(result)
    names = ("fit.json", "report.html", *written, *([EFFECTS] if entries else []))
    with _together(out, names) as (figures, report, *rest):
        for path, model in zip(models, rest, strict=False):
            write_model(
                path,
                calibrated(result, path=path),
                model,
                joints=result.joints,
                note=note(path),
                stated=restated(result, path),
                pair=word,
            )
        listed = [{"given": str(path), "written": name} for path, name in zip(models, written, strict=True)]
        write_text(figures, json_text({**result.as_json(), "models": listed, **more}))
        fit_report(result).write(report)
        effects = rest[len(models) :]
        for path in effects:
            write_text(path, as_toml(entries, note(result.model)))
    # What an earlier fit left here would pass for a part of this one.
    for name in earlier - set(names):
        (out / name).unlink(missing_ok=True)
    if not entries:
        (out / EFFECTS).unlink(missing_ok=True)
    if richer is None:
        shutil.rmtree(out / WITH_EFFECTS, ignore_errors=True)
        return [out / name for name in names]
    return [*(out / name for name in names), *write_fit(richer, out / WITH_EFFECTS)]


def stating_both(plain: Identification, tried: Identification) -> Identification:
    """The plain fit with a note of what it and one with effects leave of what they are judged by; and with that one, if it wins."""
    full, short = (
        f"plain {number(one, 'rad', name='gap')}, with effects {number(other, 'rad', name='gap')}"
        for one, other in ((plain.after.full, tried.after.full), (plain.after.horizon, tried.after.horizon))
    )
    judged = "runs left out in turn" if plain.in_turn else "held-out runs"
    errors = f"Error on {judged}: {full} over full runs; {short} at {exact(HORIZON_S, 's')}."
    if both := chosen_in_turn(tried, plain):
        errors += f" Chosen between the two anew without each: {number(both.full, 'rad', name='gap')} and {number(both.horizon, 'rad', name='gap')}."
    found = [
        f"{said(value.name)} {number(value.value, value.unit)}"
        for value in tried.values
        if value.accepted and value.value and value.name.partition(".")[0] in TRIED
    ]
    wins = better(tried, plain)
    if wins:
        note = (
            f"More is explained by what plain MuJoCo has no feature for, {', '.join(found)}. {errors} These effects act in "
            f"openant_env, beside their own model alone; both are in {WITH_EFFECTS}, and with --robot they are the robot's."
        )
    else:
        note = f"{errors} What plain MuJoCo has no feature for ({', '.join(map(said, TRIED))}) does not pay here: the plain model is the best."
    winner = replace(tried, notes=(*tried.notes, errors)) if wins else None
    return replace(plain, notes=(*plain.notes, note), with_effects=winner)


def pair_of(result: Identification) -> str | None:
    """The mark of the models of a fit and of the effects that were fitted with them; None where they are as they were given."""
    if not np.any(result.u):
        return mark_of(result.datasets[0].plant.model)
    if not result.effects:
        return PLAIN
    told = {
        "values": [[value.name, value.value] for value in result.values],
        "models": [path.name for path in result.models],
    }
    return hashlib.sha256(json_text(told).encode()).hexdigest()[:12]


def pairs(plain: Identification, richer: Identification) -> dict[str, Any]:
    """Both pairs for `fit.json`: their files, what they leave of what they are judged by, and which wins by the folds."""

    def one(result: Identification, folder: str) -> dict[str, Any]:
        figures = result.as_json()["held_out"]["after"]
        effects = {"effects": f"{folder}{EFFECTS}"} if result.effects else {}
        return {"model": f"{folder}{_models(result)[0]}", **effects, **figures}

    both = chosen_in_turn(richer, plain)
    return {
        "wins": "with_effects",
        "chosen_in_turn": both and both.as_json(),
        "plain": one(plain, ""),
        "with_effects": one(richer, f"{WITH_EFFECTS}/"),
    }


def _models(result: Identification) -> list[str]:
    models = result.models
    return [CALIBRATED] if len(models) == 1 else [f"calibrated-{name}.xml" for name in names_of(models)]


def _written_before(out: Path) -> set[str]:
    """The models that a fit.json in `out` says were written beside it."""
    try:
        entries = read_json(out / "fit.json").get("models", ())
        names = {Path(str(entry["written"])).name for entry in entries}
    except (OSError, BadInput, AttributeError, KeyError, TypeError):
        names = set[str]()
    return {name for name in names | {CALIBRATED} if name.startswith("calibrated") and name.endswith(".xml")}


@contextmanager
def _together(folder: Path, names: Sequence[str]) -> Iterator[list[Path]]:
    """Places to write files to that appear in `folder` together once the block is left; by an error, none appears.

    Raises:
        OSError: what went wrong in writing them, with the folder's name.
    """
    was_there = folder.exists()
    staged = [folder / f".{name}.new" for name in names]
    try:
        yield staged
        for path, name in zip(staged, names, strict=True):
            os.replace(path, folder / name)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from error
    finally:
        for path in staged:
            with contextlib.suppress(OSError):
                path.unlink()
        if not was_there:
            with contextlib.suppress(OSError):
                folder.rmdir()  # fails where something stands in it, as it should


def write_robot(result: Identification, folder: RobotFolder) -> None:
    """Put the calibrated model into a robot's folder, and every accepted value with where it came from into `robot.toml`.

    Of a fit to runs of several gains that is the given model, or the first run's.
    """
    source_file = result.model if result.model in result.models else result.models[0]
    write_model(
        source_file,
        calibrated(result, path=source_file),
        folder.path / CALIBRATED,
        joints=result.joints,
        note="Written by `openant sysid fit`",
        stated=restated(result, source_file),
        pair=pair_of(result),
    )
    runs = [run for data in result.datasets for run in data.runs]
    recording = folder.relative(runs[0].path) if runs[0].path else runs[0].name
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)

    def source(how: str = "fitted", low: float | None = None, high: float | None = None) -> Provenance:
        return Provenance(how, "openant sysid fit", recording, now, low, high)

    values: dict[str, object] = {"model": CALIBRATED}
    provenance = {"model": source()}
    for value in result.values:
        kind, _, label = value.name.partition(".")
        for joint in value.joints or (label,):
            # What stayed at its prior is written too: it must not be an older fit's value that is read beside this model.
            path = f"identified.{kind}.{joint}"
            values[path] = stored(value.value)
            provenance[path] = (
                source("fitted", value.low and stored(value.low), value.high and stored(value.high))
                if value.accepted
                else source("not in the data" if value.verdict == "not in the data" else "as given")
            )
    finding = {**result.as_json(), "date": now.isoformat()}
    write_text(
        folder.findings / f"sysid-fit-{now:%Y%m%dT%H%M%SZ}.json",
        json_text(finding),
    )
    word = pair_of(result)
    found = [replace(entry, pair=word) for entry in entries_of(result.effects_found, result.joints)]
    with folder.hold():  # between what is read of the effects and what is written
        folder.update(values, provenance=provenance, effects=[*effects_beside(result, folder), *found])


def effects_beside(result: Identification, folder: RobotFolder) -> list[EffectEntry]:
    """The robot's `[[effect]]` entries that were not fitted, which stay as they are; of one that was, the joints that were
    not. What was fitted with an earlier model stays where this fit went on from that one, and is of the new pair then; else it
    goes with its model."""
    fitted = {kind.effect[0] for kind in (KINDS[p.kind] for p in result.parameters if p.kind in KINDS) if kind.effect}
    acted, given = {name for name, _ in result.acting}, mark_of(result.datasets[0].plant.model)
    config, beside = folder.config(), list[EffectEntry]()
    for entry in config.effects:
        mine = tuple(config.motors) if isinstance(entry.joints, str) else entry.joints
        rest = tuple(joint for joint in mine if joint not in result.joints)
        if entry.effect in fitted:
            if effect(entry.effect).shared or not rest:
                continue
            entry = replace(entry, joints=rest)
        elif entry.pair is not None and entry.effect not in acted and rest != mine and entry.enabled:
            continue
        if entry.pair is None or not entry.enabled:
            beside.append(entry)
        elif entry.pair == given:
            beside.append(replace(entry, pair=pair_of(result)))
    return beside
