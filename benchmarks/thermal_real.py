"""The two-node model on a real robot's temperatures: fitted until 1867 s, shown against what came later.

    python benchmarks/thermal_real.py [--picture FILE.png]

The log (tests/data/static_load.csv, with its source) has temperatures and poses, neither load nor room. Heat is therefore a
number a pose and joint, fitted too. Until 1867 s the knees are held in one pose; some time before the next row they are held
in another, in which they bear another load that nobody logged. So hips, whose pose stays, are forecast; knees are forecast
within what physics allows: the new pose heats between not at all and as much as the old one, from a moment between the two rows.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from openant_tools.recording.tables import read_run
from openant_tools.report import plots
from openant_tools.thermal.fit import Fit, fit
from openant_tools.thermal.inputs import inputs_of
from openant_tools.thermal.physics import advance

DATA = Path(__file__).parents[1] / "tests" / "data" / "static_load.csv"
#: s: the last row of the first pose, and the first row of the second
FITTED_S, MOVED_S = 1867.0, 2451.0
DRAWS, STEP_S = 500, 20.0
#: K per √h of the room, as in `forecast`
ROOM_K = 1.0


def later(found: Fit, until_s: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(n,) s and (draws, n, joints) °C of the cases after the fitted part."""
    random = np.random.default_rng(seed)
    variants = found.variants(DRAWS, seed)
    knee = np.array([joint.startswith("knee") for joint in found.inputs.joints])
    kept = np.where(knee, random.uniform(0.0, 1.0, (DRAWS, len(knee))), 1.0)
    moved = random.uniform(FITTED_S, MOVED_S, (DRAWS, 1))
    t = np.arange(FITTED_S + STEP_S, until_s + STEP_S, STEP_S)
    state, offset, room = variants.state, variants.offset, variants.servos.room_c.copy()
    fade = np.exp(-STEP_S / found.disturbance_s)
    servos = replace(variants.servos, by_duty=np.zeros(len(knee), bool))
    out = []
    for now in t:
        room = room + ROOM_K * np.sqrt(STEP_S / 3600.0) * random.standard_normal((DRAWS, 1))
        drive = variants.held * np.where(now > moved, kept, 1.0)
        state = advance(servos, state, STEP_S, drive, found.inputs.gear[-1], found.inputs.idle[-1], room)
        offset = offset * fade + found.disturbance_k * np.sqrt(1 - fade**2) * random.standard_normal(offset.shape)
        out.append(state.case + offset)
    return t, np.stack(out, axis=1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    run = read_run(DATA, need=())
    whole = inputs_of(run)
    first = fit([whole.until(FITTED_S)])
    t, paths = later(first, float(run.t[-1]))
    print("| joint | " + " | ".join(f"{s:.0f} s: read, forecast" for s in run.t[run.t > FITTED_S]) + " |")
    print("|---|" + "---|" * int((run.t > FITTED_S).sum()))
    inside, total = {"hip": 0, "knee": 0}, {"hip": 0, "knee": 0}
    for k, joint in enumerate(whole.joints):
        cells = []
        for when, seen in zip(run.t, run.column(f"temp.{joint}"), strict=True):
            if when <= FITTED_S:
                continue
            drawn = np.floor(paths[:, np.argmin(np.abs(t - when)), k])
            low, middle, high = np.quantile(drawn, [0.025, 0.5, 0.975])
            good = low <= seen <= high
            inside[joint[:-3]] += good
            total[joint[:-3]] += 1
            cells.append(f"{seen:.0f}, {middle:.0f} ({low:.0f} … {high:.0f}){'' if good else ' **outside**'}")
        print(f"| {joint} | " + " | ".join(cells) + " |")
    print(
        f"\nInside the 95 % interval: hips {inside['hip']} of {total['hip']}, knees {inside['knee']} of {total['knee']}."
    )
    case = first.replayed(whole.until(FITTED_S))
    rows = run.t <= FITTED_S
    missed = np.sqrt(np.mean(first.residual_k**2))
    print(
        f"The fit misses its own {int(rows.sum()) * len(whole.joints)} readings by {missed:.2f} K rms (cell ½ °C: 0.29 K)."
    )
    both = fit([whole])
    print(f"Fitted to all rows, a heat for each pose: {np.sqrt(np.mean(both.residual_k**2)):.2f} K rms.")
    if options.picture:
        figure, axes = plots.figure(4, 2, height=1.7, sharex=True, sharey=True)
        with plots.style():
            for k, joint in enumerate(whole.joints):
                panel = axes[k // 2, k % 2]
                panel.plot(first.inputs.edges[1:] / 60, case[0, :, k] - 0.5, color=plots.BLUE, label="fitted")
                low, middle, high = np.quantile(paths[:, :, k] - 0.5, [0.025, 0.5, 0.975], axis=0)
                panel.fill_between(t / 60, low, high, color=plots.SKY, alpha=0.35, linewidth=0, label="forecast, 95 %")
                panel.plot(t / 60, middle, color=plots.BLUE, linestyle="--", label="median")
                panel.plot(run.t / 60, run.column(f"temp.{joint}"), "o", color=plots.INK, label="read")
                panel.axvline(FITTED_S / 60, color=plots.INK, linewidth=0.8, linestyle=":")
                panel.set_title(joint)
            for panel in axes[-1]:
                panel.set_xlabel(plots.axis_label("time", "min"))
            for panel in axes[:, 0]:
                panel.set_ylabel(plots.axis_label("case", "°C"))
            plots.legend(axes[0, 0], loc="lower right", bbox_to_anchor=(1.0, 0.0), ncols=2, fontsize=7)
        options.picture.write_bytes(plots.as_png(figure, 100))
    return 0


if __name__ == "__main__":
    sys.exit(main())
