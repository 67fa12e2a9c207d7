"""What of robots would be said if a sensor were not there: the same fits, and evidence without that signal.

    python -m benchmarks.gap_training.sensors SET… --keep benchmarks/gap_training/without_current

Fits follow joint positions, IMU and tracker; what servos say of torque and voltage is in the evidence alone. So evidence is made anew from
the robots that `prepare` has simulated, and the rows are those that `decision --keep` has kept. A robot that is kept already is not done
again: the same command goes on.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.gap_training.decision import Judged, short
from openant_tools.blind.run import folders_of, recorded_of
from openant_tools.files import write_text
from openant_tools.gap.assess import assess
from openant_tools.gap.decide import Anomaly
from openant_tools.gap.diagnose import content
from openant_tools.gap.experiment import Experiment
from openant_tools.sysid.identify import joints_in_common

#: what is left out: motor torque, by current or load
SIGNAL = "torque"


def without(one: Judged, kept: Mapping[str, Any]) -> Judged:
    """A robot as it would be judged by evidence that was kept of it without a signal."""
    rows = [
        dataclasses.replace(row, fit=kept["fit"].get(row.causes[0], 0.0)) if len(row.causes) == 1 else row
        for row in one.rows
    ]
    return dataclasses.replace(one, rows=tuple(rows), anomaly=Anomaly(*kept["anomaly"]))


def evidence(robot: Path, model: Path) -> dict[str, Any] | None:
    """Cause → how far a robot's recording goes along it, and how far it is from the model, without the signal; None: it has none."""
    runs, held_out, named = recorded_of(robot, model)
    joints = joints_in_common([*runs, *held_out], named, None)
    # Sorted as a diagnosis does, which has prepared it.
    protocol = Experiment.of(sorted(runs, key=content), named, joints, sorted(held_out, key=content)).protocol
    if not any(SIGNAL in one.seen for one in protocol.runs):
        return None
    with threadpool_limits(1, "blas"):
        found = assess(protocol, without=(SIGNAL,))
    anomaly = found.evidence.anomaly
    fit = {cause: short(value) for cause, value in found.fit.items()}
    return {"anomaly": [short(anomaly.size), short(anomaly.left)], "fit": fit}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", type=Path, nargs="+")
    parser.add_argument("--robots", type=int, default=None, help="of each set, the first")
    parser.add_argument("--keep", type=Path, required=True)
    options = parser.parse_args()
    for folder in options.sets:
        path = options.keep / f"{folder.name}.json"
        kept: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        for n, robot in enumerate(folders_of(folder)[: options.robots]):
            if str(n) in kept:
                continue
            kept[str(n)] = evidence(robot, folder / "model.xml")
            lines = [f"{json.dumps(k)}:{json.dumps(one, separators=(',', ':'))}" for k, one in kept.items()]
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")
            print(folder.name, n, "has none" if kept[str(n)] is None else "done", flush=True)


if __name__ == "__main__":
    main()
