"""Comms health as a step: what the bus can, measured with torque off; then what it loses while the legs swing, and why."""

from __future__ import annotations

from dataclasses import replace

from openant_tools.calib.comms_health import comms_health
from openant_tools.calib.wires import engine_config
from openant_tools.comms.dropouts.diagnose import diagnose_dropouts
from openant_tools.comms.dropouts.outcome import dropouts_finding
from openant_tools.comms.soak import soak
from openant_tools.numbers import exact, number
from openant_tools.procedure.by_time import minutes, noted
from openant_tools.procedure.finding import together
from openant_tools.procedure.relay import relayed, within
from openant_tools.procedure.step import Ask, Bench, Intent, Procedure, Say
from openant_tools.procedure.unfinished import Parts, forget, unfinished
from openant_tools.recording.tables import read_run

__all__ = ["comms_step"]

COMMAND = "openant calib comms"
#: Long enough for every joint to swing to both sides and back, and to rest; an hour finds what is rare.
DEFAULT_MIN, LONGEST_MIN = 1.0, 600.0
#: share of the step that passes with torque off
AT_REST = 0.2


def comms_step(bench: Bench) -> Procedure:
    """Measure, soak, diagnose; one finding of both.

    Raises:
        HardwareFault: not all servos answer.
    """
    still = yield from within((0.0, AT_REST), comms_health(bench))
    left = unfinished(bench.folder, "comms", virtual=bench.virtual)
    path = None if left is None else left.recording(bench.folder)
    length = None if left is None or path is None else next(iter(left.done.values())).get("minutes")
    resume = length is not None
    if path is None or length is None:
        asked = yield Ask(
            "Now watch the bus while the legs swing. For how long? (0: not at all; an hour finds what is rare)",
            unit="min", default=DEFAULT_MIN, low=0.0, high=LONGEST_MIN,
        )  # fmt: skip
        length = float(asked) if isinstance(asked, int | float) else DEFAULT_MIN
        if length == 0.0:
            return still
        forget(bench.folder, "comms", virtual=bench.virtual)  # nothing of it is there any more
        path = bench.folder.new_recording("comms-soak")
    parts = Parts(bench, "comms", minutes(60 * length))
    if resume:
        yield Say(parts.words)
    yield Intent(
        f"swing all legs gently on the stand until it was {exact(length)} min in all, and keep what the bus loses"
        if resume
        else f"swing all legs gently on the stand for {exact(length)} min, and keep what the bus loses",
        moves=True,
    )
    config, text = engine_config(bench), bench.folder.config_file.read_text(encoding="utf-8")
    soaking = soak(config, path, 60 * length, resume=resume, robot_toml=text)
    soaked = yield from within(
        (AT_REST, 1.0), noted(soaking, parts, minutes=length, recording=bench.folder.relative(path))
    )
    told = yield from relayed(lambda progress: diagnose_dropouts([read_run(path, need=())]))
    moving = dropouts_finding(told, [bench.folder.relative(path)], COMMAND)
    if soaked.whole:
        parts.end()
    else:
        why = f"the legs swung for {number(soaked.seconds, 's')} of {number(60 * length, 's')}: {soaked.ended or 'motion stopped'}"
        moving = replace(moving, ok=together(moving.ok, None), unsure=(*moving.unsure, f"{why} → run it again"))
    return replace(
        still,
        ok=together(still.ok, moving.ok),
        what=f"{still.what}; while it moved: {moving.what}",
        evidence=(*still.evidence, *moving.evidence),
        problems=(*still.problems, *moving.problems),
        unsure=(*still.unsure, *moving.unsure),
        next_action="; ".join(words for words in (moving.next_action, still.next_action) if words),
        data={**still.data, **moving.data},
    )
