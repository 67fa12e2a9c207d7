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

from openant_tools.model.gap import gap
from openant_tools.model.plant import load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run
from openant_tools.sysid.identify import identify
from openant_tools.sysid.result import write_fit

#: a Feetech STS3215 that turns an SO-101 about its vertical axis, no gravity on it. Stiffness and damping: BAM's M1 figures of
#: this servo at its default gain of 32 and 7.4 V, halved for the gain of 16 in the log; the arm's inertia about the axis is
#: a guess of 0.02 kg·m² that a fit may book in the armature.
ROTATION = """
<mujoco model="so101_rotation">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 0" mass="0.5" diaginertia="0.02 0.02 0.02"/>
      <joint name="Rotation" type="hinge" axis="0 0 1" armature="0.028" damping="0.61"/>
    </body>
  </worldbody>
  <actuator>
    <position name="Rotation" joint="Rotation" kp="8.65" forcerange="-2.9 2.9"/>
  </actuator>
</mujoco>
"""


def full_error(run: Run, model: Path, joints: Sequence[str] | None) -> float:
    plant = load_plant(model, joints)
    return gap(run.signal("pos", plant.joints), Rollouts(plant, [run])().pos[0])


def table(
    title: str,
    groups: dict[Path, list[Run]],
    work: Path,
    joints: Sequence[str] | None = None,
    kinds: Sequence[str] | None = None,
    together: bool = True,
) -> None:
    print(f"\n### {title}\n")
    print("| held out | given (rad) | others fitted (rad) | ratio | all fitted (rad) | ratio | accepted |")
    print("|---|---|---|---|---|---|---|")
    for model, runs in groups.items():
        out = work / model.stem
        result = identify(runs, model, joints=joints, kinds=kinds) if together else None
        if result is not None:
            write_fit(result, out)
        for run in runs:
            others = [other for other in runs if other is not run]
            begun = time.monotonic()
            single = identify(others, model, [run], joints=joints, kinds=kinds)
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
        model = options.work / "so101_rotation.xml"
        model.parent.mkdir(parents=True, exist_ok=True)
        model.write_text(ROTATION.strip())
        runs = [read_run(path) for path in sorted((options.shared / "sage-so101").glob("*.parquet"))]
        # Where the joint is not commanded to move there is nothing to identify.
        runs = [
            run for run in runs if float(run.column("cmd.Rotation").max() - run.column("cmd.Rotation").min()) > 0.05
        ]
        table("sage-so101, joint Rotation", {model: runs}, options.work, ["Rotation"], together=False)


if __name__ == "__main__":
    main()
