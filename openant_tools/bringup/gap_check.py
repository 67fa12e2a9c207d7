"""Gap check as a step: how far nominal and calibrated simulation are from the robot, joint by joint."""

from __future__ import annotations

import math

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.gap.measure import Measurement, difference, measure
from openant_tools.gap.words import part_words
from openant_tools.numbers import number
from openant_tools.procedure.finding import Evidence, Finding, latest
from openant_tools.procedure.relay import relayed
from openant_tools.procedure.step import Bench, Procedure
from openant_tools.recording.tables import read_run
from openant_tools.robot.folder import NOMINAL_MODEL

__all__ = ["gap_by_joint", "gap_check"]

COMMAND = "openant bringup"
#: standard errors beyond which one model is called nearer than the other
SURE = 2.0


def gap_check(bench: Bench) -> Procedure:
    """Measure on the recording that the fit held out.

    Raises:
        BadInput: nothing was identified yet.
    """
    identified = latest(bench.folder, "identify", real=not bench.virtual)
    if identified is None:
        raise BadInput("nothing was identified yet", remedy="do the step Identification first")
    runs = [read_run(bench.folder.path / name) for name in identified.data["held_out"]]
    config = bench.folder.config()
    # The robot's own simulation is its model with what acts beside it, as in openant_env.
    models = ((bench.folder.path / NOMINAL_MODEL, ()), (bench.folder.model_path(config), config.effects))
    found: list[Measurement] = []
    for model, effects in models:
        one = yield from relayed(
            lambda progress, model=model, effects=effects: measure(runs, model, effects=effects)  # type: ignore[misc]
        )
        found.append(one)
    before, after = found
    if "pos" not in before.gaps or "pos" not in after.gaps:
        raise BadInput(after.doubt or before.doubt, remedy="do the step Identification again")
    closed = 1 - after.excess("pos") / before.excess("pos") if before.excess("pos") > 0 else math.nan
    change, spread = difference(before, after)
    better, worse = change < -SURE * spread, change > SURE * spread
    unsure = (
        []
        if math.isfinite(closed)
        else ["gap closed: the nominal model is off by no more than the floor → nothing to judge by"]
    )
    if not better and not worse:
        unsure.append("which of both models is nearer cannot be told from this recording: they differ by chance alone")
    unsure += [after.doubt] if after.doubt else []
    worst = after.places[0] if after.places else None
    return Finding(
        "gap",
        False if worse else None if unsure else True,
        f"simulated joints are {number(after.gaps['pos'], 'rad', name='error', decimals=2)} off (nominal {number(1e3 * before.gaps['pos'], decimals=2)}, "
        f"floor {number(1e3 * after.floors['pos'], decimals=2)})"
        + (f"; {part_words(worst.share, worst.joint, worst.regime)}" if worst else ""),
        (
            Evidence("position gap, nominal", before.gaps["pos"], "rad", "0.5 s horizon, held-out recording"),
            Evidence("position gap, calibrated", after.gaps["pos"], "rad", "the same", most=before.gaps["pos"]),
            Evidence("floor", after.floors["pos"], "rad", "repeats of the recording"),
            Evidence("gap closed", closed, "share", "of what the nominal model is off beyond the floor"),
        ),
        "the calibrated model is worse: record again, or `openant gap diagnose`"
        if worse
        else "train on the calibrated model, which is no worse; `openant gap diagnose` tells what it lacks"
        if unsure
        else "",
        COMMAND,
        data={"by_joint_rad": gap_by_joint(after), "measure": after.as_json()},
        problems=("the calibrated model is farther off than the nominal one",) if worse else (),
        unsure=tuple(unsure),
    )


def gap_by_joint(found: Measurement) -> dict[str, float]:
    """joint → rms of measured minus simulated position, rad."""
    off = np.concatenate([one.measured["pos"] - one.simulated["pos"] for one in found.played])
    known = [off[np.isfinite(off[:, k]), k] for k in range(len(found.joints))]
    return {
        joint: float(np.sqrt(np.mean(each**2))) if len(each) else math.nan
        for joint, each in zip(found.joints, known, strict=True)
    }
