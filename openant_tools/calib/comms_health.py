"""Comms health: losses, rate and the quiet that servos need after a write, measured with torque off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from openant_tools.calib.lost_answers import loose, lost_alone, most_lost
from openant_tools.calib.wires import opened_bus, robot_servos, wait
from openant_tools.comms.bench import measure_gap, measure_rate
from openant_tools.comms.faults import Cause
from openant_tools.comms.lateness import ENOUGH, LATE_S, REMEDY
from openant_tools.comms.servos import BLOCK_ADDRESS, BLOCK_SIZE, Servos
from openant_tools.numbers import exact, number
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Bench, Procedure, Progress, Say
from openant_tools.robot.config import Provenance

__all__ = ["comms_health"]

COMMAND = "openant calib comms"
#: Cycles at the control rate, as long as a builder is willing to wait.
CYCLES, RATE_HZ = 500, 100.0
#: s of writing and reading as fast as it goes
FAST_S = 2.0
#: Of what the wire would allow; less is an adapter that holds answers back.
RATE_SHARE = 0.35


def comms_health(bench: Bench) -> Procedure:
    """Measure and judge; the gap after a write goes into robot.toml.

    Raises:
        HardwareFault: not all servos answer.
    """
    config = bench.folder.config()
    problems = list[str]()
    with opened_bus(bench) as bus:
        servos = Servos(bus, robot_servos(config))
        servos.identify()
        servos.set_torque(False)
        yield Progress(0.1, f"{CYCLES} reads at {exact(RATE_HZ)} Hz")
        delays = servos.read_all("return_delay_time")
        bus.timing = replace(bus.timing, return_delay_s=max(delays.values()) * 2e-6)
        missed, punctual = 0, list[list[bool]]()
        bus.clock.lateness.mark()
        for _ in range(CYCLES):
            answers = bus.sync_read(BLOCK_ADDRESS, BLOCK_SIZE, servos.ids)
            late = bus.clock.lateness.cycle() > LATE_S
            excused = [not answer.ok and (late or answer.cause is Cause.LATE) for answer in answers]
            missed += sum(excused)
            if not late:
                punctual.append([not (answer.ok or mine) for answer, mine in zip(answers, excused, strict=True)])
            wait(bus.clock, 1 / RATE_HZ)
        rows = np.reshape(np.array(punctual, bool), (-1, len(servos.ids)))
        lost = dict(zip(servos.joints, rows.sum(axis=0).tolist(), strict=True))
        asked = CYCLES * len(lost)
        host = bus.clock.lateness.words or "answers came late"
        yield Progress(0.5, "as fast as it goes")
        rate = measure_rate(bus, servos.ids, FAST_S)
        yield Progress(0.8, "the pause that is needed between writing and reading")
        trials, gap = measure_gap(bus, servos.ids)
        busy = bus.clock.lateness.busy
    if missed:
        words = f"{host}: {missed} of {asked} answers were missed by that, and say nothing of servos and cables"
        yield Say(f"{words} → {REMEDY}", "warn")
        if len(rows) < CYCLES * ENOUGH:
            problems.append(f"cannot judge the cables, because {words} → {REMEDY}")
    if len(rows) >= CYCLES * ENOUGH:
        problems += loose(lost_alone(servos.joints, rows), config.bus.chain, moving=False)
    if rate.hz < RATE_SHARE * rate.limit_hz and busy:
        problems.append(f"cannot judge the rate, because {host} → {REMEDY}")
    elif rate.hz < RATE_SHARE * rate.limit_hz:
        problems.append(
            f"the bus manages {number(rate.hz, 'cycles/s', decimals=0)} of {number(rate.limit_hz, decimals=0)} → the adapter's latency timer (`openant calib connect`) or "
            "the servos' return delay (`openant calib inventory`)"
        )
    if gap is None and busy:
        problems.append(f"cannot judge the pause after a write, because {host} → {REMEDY}")
    elif gap is None:
        problems.append("reads fail whatever the pause after a write → noise on the bus, or a bad cable")
    elif abs(gap - config.bus.write_read_gap_s) > 1e-6:
        # Never below what robots in the field were found to need.
        bench.folder.update({"bus.write_read_gap_s": max(gap, 0.2e-3)}, provenance=Provenance.measured(COMMAND))
    return Finding(
        "comms",
        not problems,
        f"{sum(lost.values())} of {asked} answers lost at {exact(RATE_HZ)} Hz; {rate.words}",
        (
            Evidence(
                "answers lost",
                sum(lost.values()) / asked,
                "share",
                f"{CYCLES} reads at {exact(RATE_HZ)} Hz",
                most=most_lost(asked) / asked,
            ),
            *(
                [
                    Evidence(
                        "cycles a second",
                        rate.hz,
                        "Hz",
                        f"write and read; the wire allows {number(rate.limit_hz, decimals=0)}",
                        least=RATE_SHARE * rate.limit_hz,
                    )
                ]
                if rate.believable
                else []
            ),
            Evidence("pause needed between writing and reading", gap, "s", f"{trials[0].tries} reads for each gap"),
        ),
        "mend what is listed and run it again" if problems else "",
        COMMAND,
        data={"lost": lost} | ({"rate_hz": rate.hz} if rate.believable else {}),
        problems=tuple(problems),
    )
