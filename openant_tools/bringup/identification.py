"""Identification as a step: a motion on the stand, another one twice to judge by, and the fit."""

from __future__ import annotations

import datetime
from typing import Any

from openant_tools import sysid
from openant_tools.calib.wires import engine_config
from openant_tools.comms.state import of_robot_toml
from openant_tools.files import known
from openant_tools.numbers import number
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.relay import passing, relayed, within
from openant_tools.procedure.step import Bench, Event, Intent, Kept, Procedure, Say
from openant_tools.procedure.unfinished import Parts
from openant_tools.recording.tables import read_run
from openant_tools.robot.folder import NOMINAL_MODEL
from openant_tools.sysid.kinds import said
from openant_tools.sysid.protocols import protocols
from openant_tools.sysid.record import record_takes, takes

__all__ = ["PROTOCOL", "identification"]

COMMAND = "openant bringup"
PROTOCOL = "stand"
#: s of each recording: a fit takes as long as its data, and this is what tells friction and inertia apart.
RECORD_S = 16.0
#: share of the step that recording takes
RECORDED = 0.3
#: what is recorded, in order; the fit, which asks nobody, follows
REPEATS = "the robot repeats itself too badly → screws, gears, the stand; close what keeps this computer busy, and do it again"
TAKES = ("the motion to fit", "another to judge by", "the same again", "fit")


def identification(bench: Bench) -> Procedure:
    """Record, fit, write calibrated.xml; what beats nothing leaves the nominal model where it is."""
    parts = Parts(bench, "identify", TAKES)
    robot = _robot(bench)
    before = {name: facts for name, facts in parts.before.items() if facts["robot"] == robot}
    if before:
        yield Say(parts.words)
    elif parts.before:
        yield Say("robot.toml is another than when it was left: every motion is recorded again", "warn")
    stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%SZ")
    stamp = next((str(facts["stamp"]) for facts in before.values()), stamp)
    out = bench.folder.recordings / f"identify-{stamp}.mcap"
    played = protocols(PROTOCOL, RECORD_S)
    wanted = takes(out, played, 0)
    judge = takes(out.with_name(f"identify-{stamp}-held-out.mcap"), played, 1, repeats=2)
    named = {take.path: name for name, take in zip(TAKES, [*wanted, *judge], strict=False)}
    missing = [take for take in [*wanted, *judge] if named[take.path] not in before or not take.path.is_file()]
    if missing:
        much = f"{len(missing)} × {number(RECORD_S, 's', decimals=0)}"
        yield Intent(
            f"move all joints on the stand, legs free, {much}, then adjust the simulation to the recordings", moves=True
        )
        for take in missing:
            if take.path.is_file():  # cut short
                take.path.rename(bench.folder.new_recording(f"{take.path.stem}-cut-short"))
        recording = record_takes(
            engine_config(bench, imu=None),
            missing,
            robot_toml=bench.folder.config_file.read_text(encoding="utf-8"),
        )

        def note(event: Event) -> Event:
            if isinstance(event, Kept):
                parts.done(named[event.path], stamp=stamp, robot=robot)
            return event

        yield from within((0.0, RECORDED), passing(recording, note))
    fitted, held_out = [read_run(take.path) for take in wanted], [read_run(take.path) for take in judge]
    nominal = bench.folder.path / NOMINAL_MODEL
    fitting = relayed(lambda progress: sysid.fit(fitted, nominal, held_out, progress=progress))
    result = yield from within((RECORDED, 1.0), fitting)
    parts.end()
    # Geared servos rub the more the more they bear, which plain MuJoCo cannot do and the environment can.
    richer = result.with_effects
    best = richer or result
    closer = bool(best.accepted)
    shown = bench.folder.path / "fit"
    sysid.report(result, shown, robot=bench.folder.path)
    disagree = best.before.full <= best.floor
    beside = f", with {' and '.join(sorted({said(name) for name, _ in richer.effects_found}))} added" if richer else ""
    return Finding(
        "identify",
        None if result.doubt or disagree else closer,
        f"two plays of one motion differ by {number(best.floor, 'rad', name='floor', decimals=2)}, more than the nominal model is off "
        f"({number(best.before.full, 'rad', name='error', decimals=2)}): nothing to judge a fit by"
        if disagree
        else f"error on a motion it has not seen: {number(1e3 * best.before.full, decimals=2)} → {number(best.after.full, 'rad', name='error', decimals=2)}{beside}; "
        f"no model could beat {number(best.floor, 'rad', name='floor', decimals=2)}",
        (
            Evidence("error before", best.before.full, "rad", "nominal model, held-out recording, full run"),
            Evidence(
                "error after",
                best.after.full,
                "rad",
                f"calibrated model{beside}, the same recording",
                most=best.before.full,
            ),
            Evidence("floor", result.floor, "rad", "two repeats of that recording"),
        ),
        "how well it fits, joint by joint: fit/report.html"
        if closer
        else "look at fit/report.html; the nominal model stays in use",
        COMMAND,
        data={
            "report": bench.folder.relative(shown / "report.html"),
            "fitted": [bench.folder.relative(take.path) for take in wanted],
            "held_out": [bench.folder.relative(take.path) for take in judge],
            "values": {v.name: [v.value, v.low, v.high, v.verdict] for v in best.values},
        },
        unsure=(result.doubt,) if result.doubt else (REPEATS,) if disagree else (),
        problems=()
        if closer or disagree
        else ("no fitted value predicts better than the nominal model → it stays in use",),
        stands=True,
    )


def _robot(bench: Bench) -> dict[str, Any]:
    """What a recording is told by: of a robot with other zeros, limits or settings it says nothing any more."""
    config = bench.folder.config()
    motors = {joint: vars(motor) for joint, motor in config.motors.items()}
    content: dict[str, Any] = known({"motors": motors, "registers": of_robot_toml(config)})
    return content
