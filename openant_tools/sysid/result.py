"""What a fit leaves behind: `calibrated.xml`, `fit.json`, `report.html`, and the entries of `robot.toml`."""

from __future__ import annotations

import contextlib
import datetime
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from openant_tools.effects.catalogue import effect
from openant_tools.effects.entries import as_toml, entries_of
from openant_tools.errors import BadInput
from openant_tools.files import json_text, read_json, write_text
from openant_tools.model.mjcf import write_model
from openant_tools.robot.config import Effect, Provenance
from openant_tools.robot.folder import RobotFolder
from openant_tools.sysid.identify import Identification, calibrated, restated
from openant_tools.sysid.kinds import KINDS
from openant_tools.sysid.report import fit_report

__all__ = ["WITH_EFFECTS", "effects_beside", "write_fit", "write_robot"]

CALIBRATED = "calibrated.xml"
#: beside it: what MuJoCo has no feature for
EFFECTS = "calibrated.effects.toml"
#: the folder beside it for the fit that is better with effects than any without
WITH_EFFECTS = "with-effects"


def write_fit(result: Identification, out: Path, richer: Identification | None = None) -> list[Path]:
    """Write the model, the figures and the report into `out`, together or not at all; returns what was written.

    Where nothing was accepted the model is the given one, so that a script can go on with `calibrated.xml` either way.

    Args:
        result: the fit.
        out: the folder.
        richer: what is better than it with effects that plain MuJoCo cannot play, for a folder of its own within.
    """
    runs = ", ".join(run.name for data in result.datasets for run in data.runs)

    def note(given: Path) -> str:
        return f"Calibrated by `openant sysid fit` on {datetime.date.today()} from {given.name} and {runs}"

    entries = entries_of(result.effects, result.joints)
    models, earlier = result.models, _written_before(out)
    written = [CALIBRATED] if len(models) == 1 else [f"calibrated-{path.stem}.xml" for path in models]
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
            )
        listed = [{"given": str(path), "written": name} for path, name in zip(models, written, strict=True)]
        write_text(figures, json_text({**result.as_json(), "models": listed}))
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
            values[path] = _rounded(value.value)
            provenance[path] = (
                source("fitted", value.low and _rounded(value.low), value.high and _rounded(value.high))
                if value.accepted
                else source("not in the data" if value.verdict == "not in the data" else "as given")
            )
    finding = {**result.as_json(), "date": now.isoformat()}
    write_text(
        folder.findings / f"sysid-fit-{now:%Y%m%dT%H%M%SZ}.json",
        json_text(finding),
    )
    found = entries_of(result.effects_found, result.joints)
    with folder.hold():  # between what is read of the effects and what is written
        folder.update(values, provenance=provenance, effects=[*effects_beside(result, folder), *found])


def effects_beside(result: Identification, folder: RobotFolder) -> list[Effect]:
    """The robot's `[[effect]]` entries that were not fitted, which stay as they are; of one that was, the joints that were
    not."""
    fitted = {kind.effect[0] for kind in (KINDS[p.kind] for p in result.parameters if p.kind in KINDS) if kind.effect}
    config, beside = folder.config(), list[Effect]()
    for entry in config.effects:
        if entry.effect not in fitted:
            beside.append(entry)
        elif not effect(entry.effect).shared:
            mine = tuple(config.motors) if isinstance(entry.joints, str) else entry.joints
            rest = tuple(joint for joint in mine if joint not in result.joints)
            beside += [replace(entry, joints=rest)] if rest else []
    return beside


def _rounded(value: float) -> float:
    """Six digits: more than any interval leaves meaning to, and fit for reading."""
    return float(f"{value:.6g}")
