"""Do simulations rank policies as a robot does? Three robots with sealed faults, three simulations of each.

    python benchmarks/policy_ranking.py make   --out SET [--robots 3] [--seed-from COMMIT] --key-file KEY
    python benchmarks/policy_ranking.py models --out SET
    python benchmarks/policy_ranking.py play   --out SET --policies DIR --key-file KEY
    python benchmarks/policy_ranking.py rank   --out SET --policies DIR [--docs docs/policies-result.md]

`make` draws robots with two medium or large effects each, at as many joints as they may belong to, whose answers are sealed,
and lets each play the blind benchmark's runs. `models` makes three simulations of each robot from these runs alone: the
nominal model; `sysid fit`'s of it; and the one that `gap apply` makes with the effects that were diagnosed, calibrated by
`sysid fit`, too. Diagnosing the nominal
model compares all robots with the same simulated ones, made once.
`play` lets policies walk on the true robots, simulated by the blind benchmark's own code at half a
millisecond: no line of it is the environments'. `rank` plays them in the simulations (`openant policies rank`).
Each step goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from openant_agents.policies import Policy, load_policy
from openant_agents.ranking import PlaceResult, find_policies, read_measured, write_measured
from openant_agents.runs import read_facts
from openant_env.observations import layout
from openant_env.tasks import BackAndForth
from openant_tools.blind import simulate as truth
from openant_tools.blind.answers import read_answers
from openant_tools.blind.commands import Motion
from openant_tools.blind.draw import Mix
from openant_tools.blind.log import ACC_COUNT, GYRO_COUNT, _rotation
from openant_tools.blind.make import make_set, seed_of_commit
from openant_tools.blind.mechanics import STEP_S
from openant_tools.blind.robot import TrueRobot, true_robot
from openant_tools.files import write_text
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.registers import RAD_PER_PULSE, RAD_S_PER_COUNT

#: One joint at fault of eight changes what a policy earns by as much as chance does: these are whole servo models and bodies.
MIX = Mix(none=0.0, two=1.0, outside=0.0, virtual=0.0, widest=True)
RUNS = ("stand-1", "stand-2", "floor-1", "floor-2", "floor-3")
HELD_OUT = ("stand-3", "floor-4")


def make(out: Path, count: int, commit: str, key: bytes | None) -> None:
    seed, full = seed_of_commit(commit)
    print("commitment", make_set(out, count, seed, mix=MIX, commit=full, key=key))


# ------------------------------------------------------------------------------------------------------- simulations


def openant(*words: object) -> int:
    """Run a command of ours; what it prints goes to stderr, as progress."""
    return subprocess.run(
        [sys.executable, "-m", "openant_tools.cli", *map(str, words)], stdout=sys.stderr, check=False
    ).returncode


def models(out: Path, only: str | None) -> None:
    for folder in sorted(out.glob(only or "robot-*")):
        place = out / "models" / folder.name
        runs = [folder / f"{name}.parquet" for name in RUNS]
        stand = [run for run in runs if run.name.startswith("stand")]
        held_out = [folder / f"{name}.parquet" for name in HELD_OUT]
        begun = time.monotonic()
        if not (place / "fit" / "calibrated.xml").exists():
            openant(
                "sysid", "fit", *stand, "--hold-out", held_out[0], "--model", out / "model.xml", "--no-effects",
                "--out", place / "fit",
            )  # fmt: skip
        print(f"{folder.name}: fitted in {time.monotonic() - begun:.0f} s", flush=True)
        calibrated = place / "fit" / "calibrated.xml"
        if not calibrated.exists():  # a robot that moves quite otherwise is not fitted: its calibration changes nothing
            calibrated = out / "model.xml"
        _robot(place / "calibrated", calibrated)
        begun = time.monotonic()
        diagnosis = place / "diagnosis.json"
        if not diagnosis.exists():
            words = [word for run in held_out for word in ("--hold-out", run)]
            openant("gap", "diagnose", *runs, *words, "--model", out / "model.xml", "--json", diagnosis)
        verdict = json.loads(diagnosis.read_text())["verdict"]
        print(f"{folder.name}: diagnosed as {verdict} in {time.monotonic() - begun:.0f} s", flush=True)
        diagnosed = place / "diagnosed"
        if not (diagnosed / "improved.xml").exists():
            _robot(diagnosed, out / "model.xml")
            openant(
                "gap", "apply", diagnosis, "--model", out / "model.xml", "--out", diagnosed / "improved.xml",
                "--robot", diagnosed,
            )  # fmt: skip
            # What the diagnosis moves within tolerances is a means to an end; what is left is calibrated as in the other.
            openant(
                "sysid", "fit", *stand, "--hold-out", held_out[0], "--robot", diagnosed, "--no-effects",
                "--out", place / "refit",
            )  # fmt: skip


def _robot(folder: Path, model: Path) -> None:
    if not folder.exists():
        robot = create_robot(folder)
        (folder / "calibrated.xml").write_bytes(model.read_bytes())
        robot.update({"model": "calibrated.xml"})


# ----------------------------------------------------------------------------------------------------- the true robot


class TrueWalk:
    """One true robot, many times at once, each walked by a policy of its own through clocks and sensors as they are.

    Args:
        robot: the truth.
        policies: one for each copy.
        seed: of first reward directions and of noise.
    """

    def __init__(self, robot: TrueRobot, policies: Sequence[Policy], dt: float, centre: np.ndarray, half: np.ndarray,
                 seeds: Sequence[int]) -> None:  # fmt: skip
        self.robot, self.policies, self.dt = robot, policies, dt
        self.centre, self.half = centre, half
        n = len(policies)
        commands = np.repeat(centre[None], 2, axis=0)
        motion = Motion("walk", "walk", "floor", 0.0, commands, np.zeros((2, 8), bool), False)
        self.bodies = truth._Bodies([robot] * n, motion)
        self.drives = truth._Drives([robot] * n, self.bodies, 0)
        self.layout = layout(tuple(JOINTS))
        self.turn = _rotation(robot.senses.mount_rad)
        self.random = np.random.default_rng(robot.seed)
        self.seeds = seeds
        self.tasks = [BackAndForth() for _ in policies]
        self.k = 0
        self.filtered = np.repeat(centre[None], n, axis=0)  # behind lag and slew
        self.goal = self.filtered.copy()
        self.helped = np.zeros(n, int)

    def play(self, seconds: float) -> list[float]:
        """m/s of each copy."""
        n = len(self.policies)
        on = np.ones((n, 8))
        for _ in range(round(1.5 / STEP_S)):
            self.bodies.step(self.drives.step(self.goal, on, self.k))
            self.k += 1
        self._stood = [(data.qpos.copy(), data.qvel.copy()) for _, data in self.bodies.worlds]
        for b in range(n):
            x, y, _, _ = self._pose(b)
            self.tasks[b].reset(x, y, np.random.default_rng(self.seeds[b]))
            self.policies[b].begin()
        steps, total = round(self.dt / STEP_S), np.zeros(n)
        rows = round(seconds / self.dt)
        delay, lag, slew, clocks = *self._clock(), self.robot.clocks
        share = np.where(lag > 0, 1 - np.exp(-STEP_S / np.maximum(lag, 1e-9)), 1.0)
        wanted = self.goal.copy()
        trail: list[tuple[np.ndarray, np.ndarray]] = [(self.drives.encoder.copy(), self.drives.filtered.copy())]
        for _ in range(rows):
            back = min(len(trail) - 1, round(clocks.sensor_s / STEP_S))
            encoder, velocity = trail[-1 - back]
            commands = np.stack([self._command(b, encoder[b], velocity[b]) for b in range(n)])
            arrival = clocks.gap_s + clocks.base_s + delay + clocks.jitter * self.random.standard_normal((n, 8))
            lost = self.random.random((n, 8)) < clocks.lost
            arrives = np.where(lost, steps + 1, np.clip(np.rint(arrival / STEP_S), 0, steps - 1)).astype(int)
            trail = trail[-1:]
            for i in range(steps):
                wanted = np.where(arrives == i, commands, wanted)
                step = share * (wanted - self.goal)
                self.goal = self.goal + np.clip(step, -slew * STEP_S, slew * STEP_S)
                self.bodies.step(self.drives.step(self.goal, on, self.k))
                self.k += 1
                if clocks.sensor_s:
                    trail.append((self.drives.encoder.copy(), self.drives.filtered.copy()))
            if not clocks.sensor_s:
                trail = [(self.drives.encoder, self.drives.filtered)]
            for b in range(n):
                x, y, _, up = self._pose(b)
                if not math.isfinite(x + y) or up < 0.0:
                    self._set_up(b)
                    continue
                total[b] += self.tasks[b].reward(x, y)
        return [float(one) for one in total / (rows * self.dt)]

    def _clock(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        clocks = self.robot.clocks
        return clocks.delay[None], clocks.lag[None], clocks.slew[None]

    def _pose(self, b: int) -> tuple[float, float, float, float]:
        _, data = self.bodies.worlds[b]
        w, qx, qy, qz = data.qpos[3:7]
        yaw = math.atan2(2 * (w * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        return float(data.qpos[0]), float(data.qpos[1]), yaw, float(1 - 2 * (qx * qx + qy * qy))

    def _command(self, b: int, encoder: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """(8,) rad that the policy commands, from what its sensors say."""
        senses, draw = self.robot.senses, self.random.standard_normal
        _, data = self.bodies.worlds[b]
        _, _, yaw, _ = self._pose(b)
        yaw += senses.tracker_yaw + senses.tracker_rad * draw()
        seen = np.empty(len(self.layout))
        at = self.layout.slices
        noisy = encoder + senses.encoder_rad * draw(8)
        seen[at["pos"]] = np.rint(noisy / RAD_PER_PULSE) * RAD_PER_PULSE
        seen[at["vel"]] = np.rint(velocity / RAD_S_PER_COUNT) * RAD_S_PER_COUNT
        seen[at["direction"]] = self.tasks[b].observed_direction(math.cos(yaw), math.sin(yaw))
        gyro, acc = data.sensordata[:3] @ self.turn, data.sensordata[3:6] @ self.turn
        gyro = gyro + senses.gyro_bias + senses.gyro_noise * draw(3)
        acc = acc + senses.acc_bias + senses.acc_noise * draw(3)
        seen[at["gyro"]] = np.rint(gyro / GYRO_COUNT) * GYRO_COUNT
        seen[at["acc"]] = np.rint(acc / ACC_COUNT) * ACC_COUNT
        action = np.clip(self.policies[b].likeliest(seen.astype(np.float32)), -1.0, 1.0)
        command: np.ndarray = self.centre + self.half * action
        return command

    def _set_up(self, b: int) -> None:
        """Somebody puts the robot back on its feet, where it stood first."""
        model, data = self.bodies.worlds[b]
        self.helped[b] += 1
        data.qpos[:], data.qvel[:] = self._stood[b]
        mujoco.mj_forward(model, data)
        self.bodies._read()
        drives = self.drives
        drives.rotor[b] = self.bodies.q[b]
        for name in ("rate", "bristle", "gear", "filtered", "current", "sum"):
            getattr(drives, name)[b] = 0.0
        x, y, _, _ = self._pose(b)
        self.tasks[b].reset(x, y, self.random)
        self.policies[b].begin()


def play(out: Path, policies: Path, key: bytes | None, seconds: float, plays: int, only: str | None) -> None:
    import tomllib

    import gymnasium

    import openant_env  # noqa: F401

    facts = tomllib.loads((out / "set.toml").read_text())
    answers = read_answers(out, key, facts["commitment"])
    runs = find_policies(policies)
    for name, answer in answers.items():
        file = out / "models" / name / "real.json"
        if file.exists() or only not in (None, name):
            continue
        begun = time.monotonic()
        dts = {run: read_facts(folder)["trained_on"]["dt"] for run, folder in runs.items()}
        measured: dict[str, PlaceResult] = {}
        for dt in sorted(set(dts.values())):
            chosen = [run for run in runs if dts[run] == dt]
            loaded, ranges = [], []
            for run in chosen:
                env = gymnasium.make(
                    "openant/Ant-v0",
                    **{k: v for k, v in read_facts(runs[run])["env"]["options"].items() if k != "robot"},
                )
                actions = env.unwrapped.actions
                ranges.append((actions.centre, actions.half))
                loaded.append([load_policy(runs[run], env) for _ in range(plays)])
            centre, half = ranges[0]
            assert all((c == centre).all() and (h == half).all() for c, h in ranges), "one range of actions at a time"
            walk = TrueWalk(
                true_robot(answer), [policy for copies in loaded for policy in copies], dt, centre, half,
                list(range(plays)) * len(chosen),
            )  # fmt: skip
            achieved = walk.play(seconds)
            for k, run in enumerate(chosen):
                part = slice(k * plays, (k + 1) * plays)
                measured[run] = PlaceResult.of(achieved[part], helped=int(walk.helped[part].sum()))
        write_measured(file, measured, place=name, seconds=seconds)
        print(
            f"{name}: {len(runs)} policies walked {plays} × {seconds:.0f} s in {time.monotonic() - begun:.0f} s",
            flush=True,
        )


# -------------------------------------------------------------------------------------------------------------- rank


def rank(out: Path, policies: Path, seconds: float, plays: int, docs: Path | None) -> None:
    lines = [
        "| robot | simulation | Spearman | Kendall | rank violation, cm/s | regret, cm/s | its best on the robot | error, cm/s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    sums: dict[str, list[tuple[float, ...]]] = {}
    for real in sorted(out.glob("models/*/real.json")):
        place, answer = real.parent, real.parent / "ranking.json"
        nominal = out / "nominal.json"
        if not nominal.exists():
            openant("policies", "play", "--policies", policies, "--on", "nominal", "--seconds", seconds, "--plays", plays,
                    "--json", nominal)  # fmt: skip
        words: list[object] = []
        for name in ("calibrated", "diagnosed"):
            if (place / name).exists():  # a diagnosis may still be to come
                openant("policies", "play", "--policies", policies, "--on", place / name, "--seconds", seconds,
                        "--plays", plays, "--json", place / f"{name}.json")  # fmt: skip
                words += ["--sim", f"{name}={place / name}.json"]
        if openant(
            "policies", "rank", "--policies", policies, "--real", real, "--sim", f"nominal={nominal}", *words,
            "--flag-by", "none", "--report", place / "ranking", "--json", answer,
        ):  # fmt: skip
            continue
        diagnosis, walked = place / "diagnosis.json", read_measured(real)
        verdict = json.loads(diagnosis.read_text())["verdict"] if diagnosis.exists() else "not diagnosed"
        for name, one in json.loads(answer.read_text())["agreement"].items():
            s, k = one["spearman"], one["kendall"]
            violation, lost = 100 * one["rank_violation_m_s"]["value"], 100 * one["regret_m_s"]["value"]
            # Mean over policies of how far the simulated reward is from the real one.
            there = read_measured(nominal if name == "nominal" else place / f"{name}.json")
            error = 100 * np.mean([abs(there[x].average_reward_m_s - y.average_reward_m_s) for x, y in walked.items()])
            sums.setdefault(name, []).append((s["value"], k["value"], violation, lost, float(error)))
            lines.append(
                f"| {place.name} ({verdict}) | {name} | {s['value']:.2f} [{s['low']:.2f}, {s['high']:.2f}] | {k['value']:.2f}"
                f" [{k['low']:.2f}, {k['high']:.2f}] | {violation:.1f} | {lost:.1f} | {one['best_is']} of {one['policies']} |"
                f" {error:.1f} |"
            )
    for name, values in sums.items():
        s, k, violation, regret, error = np.mean(values, axis=0)
        lines.append(
            f"| mean of {len(values)} | {name} | {s:.2f} | {k:.2f} | {violation:.1f} | {regret:.1f} | | {error:.1f} |"
        )
    text = "\n".join(lines)
    print(text)
    if docs is not None:
        write_text(docs, text + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=["make", "models", "play", "rank"])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--seed-from", default="HEAD")
    parser.add_argument("--key-file", type=Path)
    parser.add_argument("--policies", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--plays", type=int, default=3)
    parser.add_argument("--docs", type=Path)
    parser.add_argument("--only", metavar="ROBOT", help="model or play on this one only, such as robot-000")
    chosen = parser.parse_args()
    key = None
    if chosen.key_file is not None:
        from openant_tools.virtual.seal import make_key, read_key

        key = read_key(chosen.key_file) if chosen.key_file.exists() else make_key(chosen.key_file)
    if chosen.step == "make":
        make(chosen.out, chosen.robots, chosen.seed_from, key)
    elif chosen.step == "models":
        models(chosen.out, chosen.only)
    elif chosen.step == "play":
        play(chosen.out, chosen.policies, key, chosen.seconds, chosen.plays, chosen.only)
    else:
        rank(chosen.out, chosen.policies, chosen.seconds, chosen.plays, chosen.docs)


if __name__ == "__main__":
    main()
