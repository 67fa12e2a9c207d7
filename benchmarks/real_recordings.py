"""Identification on real recordings of other people's servos: held-out error before and after, motion by motion.

    python benchmarks/real_recordings.py [--shared ../shared/realdata] [--only bam-xl330|sage-so101]

Prints Markdown. For each group of runs that share a model, every run is held out once while the others are fitted; then all
are fitted together and judged by leaving out in turn. Errors are root mean squares of position over the full run.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from openant_tools.model.gap import gap
from openant_tools.model.plant import load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run
from openant_tools.sysid.identify import identify
from openant_tools.sysid.result import write_fit

#: A Feetech STS3215 of an SO-101 about an axis without gravity. Stiffness and damping: BAM's M1 figures of this servo at its
#: default gain of 32 and 7.4 V, halved for the gain of 16 in the log; what it turns (kg·m²) is a guess that a fit may book
#: in the armature.
TURNED_KG_M2 = {"Rotation": 0.02, "Wrist_Roll": 0.001}
SO101 = """
<mujoco model="so101_{joint}">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 0" mass="0.5" diaginertia="{turned} {turned} {turned}"/>
      <joint name="{joint}" type="hinge" axis="0 0 1" armature="0.028" damping="0.61"/>
    </body>
  </worldbody>
  <actuator>
    <position name="{joint}" joint="{joint}" kp="8.65" forcerange="-2.9 2.9"/>
  </actuator>
</mujoco>
"""

#: rad; less is no motion
MOVES_RAD = 0.05


def full_error(run: Run, model: Path, joints: Sequence[str] | None) -> float:
    plant = load_plant(model, joints)
    return gap(run.signal("pos", plant.joints), Rollouts(plant, [run])().pos[0])


def table(
    title: str,
    groups: dict[Path, list[Run]],
    work: Path,
    joints: Sequence[str] | None = None,
    also: Sequence[str] = (),
    together: bool = True,
) -> None:
    print(f"\n### {title}\n")
    print("| held out | given (rad) | others fitted (rad) | ratio | all fitted (rad) | ratio | accepted |")
    print("|---|---|---|---|---|---|---|")
    for model, runs in groups.items():
        out = work / model.stem
        result = identify(runs, model, joints=joints, also=also) if together else None
        if result is not None:
            write_fit(result, out)
        for run in runs:
            others = [other for other in runs if other is not run]
            begun = time.monotonic()
            single = identify(others, model, [run], joints=joints, also=also)
            write_fit(single, out / run.name)
            given = full_error(run, model, joints)
            held_out = full_error(run, out / run.name / "calibrated.xml", joints)
            accepted = ", ".join(dict.fromkeys(name.partition(".")[0] for name in single.accepted)) or "nothing"
            cells = [run.name, f"{given:.4f}", f"{held_out:.4f}", f"{held_out / given:.2f}"]
            if result is not None:
                error = full_error(run, out / "calibrated.xml", joints)
                cells += [f"{error:.4f}", f"{error / given:.2f}"]
            else:
                cells += ["", ""]
            print(f"| {' | '.join([*cells, accepted])} |", flush=True)
            print(f"{run.name}: {time.monotonic() - begun:.0f} s", file=sys.stderr)
        if result is not None:
            cells = [f"*in turn: {model.stem}*", f"{result.before.full:.4f}", f"{result.after.full:.4f}"]
            cells += [f"{result.after.full / result.before.full:.2f}", "", "", ", ".join(result.accepted) or "nothing"]
            print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "realdata")
    parser.add_argument("--only", choices=["bam-xl330", "sage-so101"])
    parser.add_argument("--joint", action="append", choices=list(TURNED_KG_M2), help="of sage-so101; default both")
    parser.add_argument("--work", type=Path, default=Path("/tmp/real_recordings"))
    options = parser.parse_args()
    if options.only != "sage-so101":
        groups: dict[Path, list[Run]] = defaultdict(list)
        for path in sorted((options.shared / "bam-xl330").glob("*.parquet")):
            run = read_run(path)
            assert run.model_path is not None
            groups[run.model_path].append(run)
        table("bam-xl330, full-run position error", groups, options.work)
    if options.only != "bam-xl330":
        recorded = [read_run(path) for path in sorted((options.shared / "sage-so101").glob("*.parquet"))]
        for joint in options.joint or TURNED_KG_M2:
            turned = TURNED_KG_M2[joint]
            model = options.work / f"so101_{joint}.xml"
            model.parent.mkdir(parents=True, exist_ok=True)
            model.write_text(SO101.format(joint=joint, turned=turned).strip())
            # Where the joint is not commanded to move there is nothing to identify.
            runs = [run for run in recorded if np.ptp(run.column(f"cmd.{joint}")) > MOVES_RAD]
            for words, also in (("delay", []), ("delay and lag", ["actuator_lag"])):
                table(f"sage-so101, joint {joint}, {words}", {model: runs}, options.work, [joint], also, together=False)


if __name__ == "__main__":
    main()
