"""Is it worth improving a simulation by what its own policy recorded? Robots with sealed faults, each through `openant loop`.

    python benchmarks/sim_to_robot.py make  --out SET --key-file KEY [--robots 5] [--seed-from COMMIT]
    python benchmarks/sim_to_robot.py run   --out SET --key-file KEY [--steps 30000 --fine-tune-steps 10000 --seconds 60]
    python benchmarks/sim_to_robot.py table --out SET [--opened] [--json FILE]

`make` draws virtual robots with two medium or large effects each, at as many joints as they may belong to, and seals them; beside
each stands the same robot before it had them. `run` calibrates a simulation of that one on its stand (`sysid record`, `sysid
fit`), so that what the loop has to find is what came since, and lets `openant loop` go its way with the sealed one. It goes on
where it was stopped, and prints the table after each robot. `table` reads the summaries that each loop has kept, and once all is
opened says what was true. Hours a robot: nothing of this runs in CI.
"""

from __future__ import annotations

import argparse
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from openant_tools.blind.draw import BUS, Answer, Mix, draw_answers
from openant_tools.blind.make import seed_of_commit
from openant_tools.blind.through_bus import scenario_of
from openant_tools.bringup.stages import openant
from openant_tools.files import json_text, read_json, write_text
from openant_tools.numbers import number
from openant_tools.procedure.intervals import Interval
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import create_robot
from openant_tools.virtual.seal import KEY_VARIABLE, make_key, read_key, seal

#: One joint at fault of eight changes what a policy earns by as much as chance does (docs/benchmarks.md): whole servo models.
MIX = Mix(none=0.0, two=1.0, outside=0.0, widest=True)
#: what changes no motion
SENSED = {"imu_misalignment", "imu_bias", "tracker_scale"}
#: robots drawn for each that is wanted: every second one has an effect of sensors
DRAWN = 8
HEALTHY, SEALED, SET = "healthy.toml", "sealed.toml", "set.json"


def make(out: Path, count: int, commit: str, key: bytes) -> None:
    seed, full = seed_of_commit(commit, Path(__file__).parent)
    drawn = {"commit": full, "seed": seed, "robots": count}
    if (out / SET).exists() and read_json(out / SET) != drawn:
        raise SystemExit(f"{out}: holds other robots; name a new folder")
    for k, answer in enumerate(_answers(seed, count)):
        place = out / f"robot-{k}"
        write_text(place / HEALTHY, _scenario(replace(answer, effects=()), "stand"))
        if not (place / SEALED).exists():
            print(place.name, "commitment", seal(_scenario(answer, "floor"), key, place / SEALED), flush=True)
    write_text(out / SET, json_text(drawn))


def _answers(seed: int, count: int) -> list[Answer]:
    drawn = draw_answers(DRAWN * count, seed, MIX, BUS)
    return [one for one in drawn if not SENSED & {effect.effect for effect in one.effects}][:count]


def _scenario(answer: Answer, setup: str) -> str:
    """The scenario of a robot, which a camera looks at."""
    document = tomllib.loads(scenario_of(answer, setup, 0.0))
    del document["camera"]
    return tomlkit.dumps(document)


def run(out: Path, key_file: Path, only: str | None, record_s: float, arguments: Sequence[str]) -> None:
    os.environ[KEY_VARIABLE] = str(key_file.resolve())
    for place in sorted(out.glob(only or "robot-*")):
        robot = place / "ant"
        if not (robot / "robot.toml").exists():
            measured = {"motors": Provenance("measured", "benchmark")}
            create_robot(robot, values={"camera.body_tag_id": 12}, provenance=measured)
        recordings = [robot / "recordings" / f"{name}.mcap" for name in ("stand", "held-out")]
        for k, recording in enumerate(recordings):
            if not recording.exists():
                _must(
                    "sysid", "record", "--virtual", place / HEALTHY, "--protocol", "stand", "--seconds", record_s,
                    "--seed", k, "--robot", robot, "--out", recording, "--yes",
                )  # fmt: skip
        if not (place / "fit" / "fit.json").exists():
            fit = ("sysid", "fit", recordings[0], "--hold-out", recordings[1], "--model", robot / "nominal.xml")
            # 1: nothing predicts better than the nominal model, which then is the calibrated one.
            _must(*fit, "--no-effects", "--robot", robot, "--out", place / "fit", ends=(0, 1))
        _must(
            "loop", "--robot", robot, "--virtual", place / SEALED, *arguments, "--out", place / "loop", "--yes",
        )  # fmt: skip
        table(out, False, None)


def _must(*words: object, ends: tuple[int, ...] = (0,)) -> None:
    code = openant([str(word) for word in words])
    if code not in ends:
        raise SystemExit(f"openant {words[0]} ended with {code}; the same command goes on from here")


# ------------------------------------------------------------------------------------------------------------- the table


def table(out: Path, opened: bool, json_file: Path | None) -> None:
    found = {file.parents[1].name: read_json(file) for file in sorted(out.glob("robot-*/loop/result.json"))}
    if not found:
        raise SystemExit(f"{out}: no loop has ended yet")
    print("| robot | diagnosed as | simulation less robot, cm/s: before | after | control | reward on the robot, cm/s: before | after"
          " | control | after less control |\n|---|---|---|---|---|---|---|---|---|")  # fmt: skip
    drawn = read_json(out / SET)
    true = {f"robot-{k}": answer for k, answer in enumerate(_answers(drawn["seed"], drawn["robots"]))}
    for name, one in found.items():
        truth = f" (is {', '.join(one.effect for one in true[name].effects)})" if opened else ""
        apart = " | ".join(_span(one["sim_minus_robot"][which]) for which in ("before", "after", "control"))
        rewards = " | ".join(
            _span(one["intervals"][which]) for which in ("robot_before", "robot_after", "control_after")
        )
        gained = "nothing to improve" if one["after_minus_control"] is None else _span(one["after_minus_control"])
        print(f"| {name}{truth} | {one['verdict']} | {apart} | {rewards} | {gained} |")
    answer = summary(list(found.values()))
    print(f"\n{len(found)} robots, {answer['improved']} improved; mean |simulation − robot| "
          f"{_span(answer['apart_before'], 'cm/s')} before, {_span(answer['apart_after'], 'cm/s')} after, {_span(answer['apart_control'], 'cm/s')} of the "
          f"control; reward on the robot after less control {_span(answer['gain'], 'cm/s')}, risen on {answer['risen']}, "
          f"surely on {answer['surely_risen']}")  # fmt: skip
    if json_file is not None:
        write_text(json_file, json_text({"robots": found, "summary": answer}, indent=2))


def summary(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Over robots, each with its 95 % interval: |simulation − robot|, m/s, and what the improvement gains over the control.

    Where there was nothing to improve, the control stands for both: nothing is gained.
    """
    gains = [one["after_minus_control"] or {"value": 0.0, "low": 0.0} for one in results]
    apart = {
        which: Interval.of_mean([abs(one["sim_minus_robot"][which]["value"]) for one in results]).as_json()
        for which in ("before", "after", "control")
    }
    return {
        **{f"apart_{which}": span for which, span in apart.items()},
        "gain": Interval.of_mean([one["value"] for one in gains]).as_json(),
        "risen": sum(one["value"] > 0.0 for one in gains),
        "surely_risen": sum((one["low"] or 0.0) > 0.0 for one in gains),
        "improved": sum(bool(one["improved"]) for one in results),
    }


def _span(one: Mapping[str, float | None], unit: str = "") -> str:
    value, low, high = (np.nan if (part := one[name]) is None else 100 * part for name in ("value", "low", "high"))
    return number(value, unit, low, high)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("step", choices=["make", "run", "table"])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--key-file", type=Path)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--seed-from", default="HEAD")
    parser.add_argument("--only", metavar="ROBOT", help="such as robot-0")
    parser.add_argument("--record-seconds", type=float, default=12.0, help="of each recording for the calibration")
    parser.add_argument("--opened", action="store_true", help="say what was true, too")
    parser.add_argument("--json", type=Path)
    parser.epilog = "Further options go to `openant loop`."
    chosen, further = parser.parse_known_args()
    if chosen.step != "table" and chosen.key_file is None:
        parser.error("--key-file is missing; `make` makes it where there is none")
    if chosen.step == "make":
        key = read_key(chosen.key_file) if chosen.key_file.exists() else make_key(chosen.key_file)
        make(chosen.out, chosen.robots, chosen.seed_from, key)
    elif chosen.step == "run":
        run(chosen.out, chosen.key_file, chosen.only, chosen.record_seconds, further)
    else:
        table(chosen.out, chosen.opened, chosen.json)


if __name__ == "__main__":
    main()
