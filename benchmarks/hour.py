"""An hour of learning on the virtual robot in real time, left alone, with faults by a script: SAC and SARSA(λ), three seeds each.

    python benchmarks/hour.py --out hours [--minutes 60] [--seeds 1 2 3] [--agents sac sarsa] [--at-once 1]

Each run trains with `--unattended` until its hour is over, by the wall clock from the robot's first connection, rests and help
included. On the way (`FAULTS`) its cable pulls throughout, a servo runs hot and rests, the tag is lost for ten seconds, the bus's
cable is out and in, the trainer is killed (`kill -9`), and this computer is busy for a minute. Where someone is needed the script
is that someone: it puts the robot back and gives the same command again, and keeps each time and why. Then come the run's
page (`openant train report`), an evaluation of five starts on the same robot, and the reference: the same seed for as many steps
as an hour has, without faults, in stepped time.

A run that has its `summary.json` is done: the same command goes on with the first one that has none, and of that with what it
lacks, the hour with its evaluation or the reference. The table of all that are done is printed, and stands in OUT/hours.md.
Nobody else should use this computer meanwhile: the virtual robot's physics and camera take their share of it, which the page
tells.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from openant_tools.bringup.run_log import read_log
from openant_tools.comms.clock import VirtualControl
from openant_tools.errors import OpenAntError
from openant_tools.files import json_text, write_text
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import create_robot

OPENANT = [sys.executable, "-m", "openant_tools.cli"]
#: steps of an hour of robot time
HOUR_STEPS = {"sac": 30_000, "sarsa": 72_000}
SCENARIO = """
[robot]
setup = "floor"
[clock]
mode = "{mode}"
"""
#: a cable from 1 m above that pulls with 0.5 N a metre
PULL = """
[[effect]]
effect = "cable_drag"
joints = "body"
parameters = { force_n = 0.0, direction = 0.0, damping_n_s_m = 0.2, stiffness_n_m = 0.5, anchor_m = [0.0, 0.0, 1.0] }
"""
#: s until a person notices, is there, and has helped
HELP_S = 10.0
#: s for which the camera may see nothing before that person puts the robot back: longer than the scripted loss
UNSEEN_S = 20.0
#: runs of the command that end at once, one after the other, until it is given up
HOPELESS = 5
#: words of a run's end after which hands are needed besides the word
HANDS = ("lies on", "cable", "camera does not see")


@dataclass(frozen=True)
class ScriptedFault:
    """What befalls the robot or this computer: at which share of the hour, and for how many s."""

    name: str
    share: float
    seconds: float
    request: Mapping[str, Any] = field(default_factory=dict)


FAULTS = (
    ScriptedFault("a servo runs hot", 0.2, 2.0, {"cause": "overheated", "where": "knee_fl", "temperature_c": 77.0}),
    ScriptedFault("the tag is lost", 0.4, 10.0, {"cause": "camera_stalled"}),
    ScriptedFault("the cable is out", 0.55, 5.0, {"cause": "usb_unplug"}),
    ScriptedFault("the trainer is killed", 0.7, 0.0),
    ScriptedFault("this computer is busy", 0.85, 60.0),
)


@dataclass
class Hour:
    """One run: an agent, a seed, its folder, and what the script did to it and for it."""

    agent: str
    seed: int
    folder: Path
    minutes: float
    happened: list[dict[str, Any]] = field(default_factory=list)
    help: list[dict[str, Any]] = field(default_factory=list)

    @property
    def name(self) -> str:
        return f"{self.agent}-{self.seed}"

    @property
    def summary(self) -> Path:
        return self.folder / "summary.json"

    def do(self) -> None:
        """The run from its beginning, or from the part that it has not done yet, to its summary."""
        lived = self._read("hour")
        if lived is None:
            self._live()
            lived = {"happened": self.happened, "help": self.help}
            write_text(self.folder / "hour.json", json_text(lived, indent=2))
        if self._read("reference") is None:
            self._refer()
        found = {
            "agent": self.agent, "seed": self.seed, "minutes": self.minutes, **lived,
            **{part: self._read(part) for part in ("page", "eval", "reference")},
        }  # fmt: skip
        write_text(self.summary, json_text(found, indent=2))

    def _live(self) -> None:
        """The hour, its page, and an evaluation on the same robot."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        create_robot(
            self.robot, values={"camera.body_tag_id": 12}, provenance={"motors": Provenance("measured", "benchmark")}
        )
        run, ready, scenario = self.folder / "run", self.folder / "ready.json", self.folder / "real.toml"
        write_text(scenario, SCENARIO.format(mode="real") + PULL)
        with self._virtual(scenario, ready):
            place = self._on(ready)
            steps = ["--steps", str(10 * HOUR_STEPS[self.agent])]
            self._learn(run, ready, [*self._train(run), "--unattended", *place, *steps])
            self._done("page", ["train", "report", str(run), "--json", str(self.folder / "page.json")])
            self._done(
                "eval", ["eval", str(run), "--env", "hardware", *place, "--starts", "5", "--seconds", "30",
                         "--json", str(self.folder / "eval.json")],
            )  # fmt: skip

    def _refer(self) -> None:
        """The same seed for as many steps as an hour has, without faults, in stepped time."""
        # What was cut goes on from its last checkpoint.
        reference, scenario = self.folder / "reference", self.folder / "stepped.toml"
        write_text(scenario, SCENARIO.format(mode="stepped"))
        steps = ["--steps", str(max(1, round(HOUR_STEPS[self.agent] * self.minutes / 60)))]
        exact = ["--learn", "sync"] if self.agent == "sac" else []
        self._done("reference", [*self._train(reference), *self._on(scenario), *steps, *exact])
        self._done("reference-page", ["train", "report", str(reference), "--json", str(self.folder / "reference.json")])

    @property
    def robot(self) -> Path:
        return self.folder / "ant"

    def _on(self, virtual: Path) -> list[str]:
        return ["--robot", str(self.robot), "--virtual", str(virtual), "--yes"]

    def _train(self, out: Path) -> list[str]:
        return ["train", self.agent, "--env", "hardware", "--seed", str(self.seed), "--out", str(out)]

    def _read(self, part: str) -> Any:
        path = self.folder / f"{part}.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None

    @contextlib.contextmanager
    def _virtual(self, scenario: Path, ready: Path) -> Any:
        with (self.folder / "virtual.txt").open("a") as said:
            virtual = subprocess.Popen(
                [*OPENANT, "virtual", "start", "--scenario", str(scenario), "--ready-file", str(ready)],
                stdout=said, stderr=said,
            )  # fmt: skip
            try:
                while not ready.is_file():
                    if virtual.poll() is not None:
                        sys.exit(f"{self.name}: no virtual robot (see {said.name})")
                    time.sleep(0.05)
                yield
            finally:
                virtual.terminate()
                virtual.wait()

    def _done(self, name: str, arguments: Sequence[str]) -> None:
        with (self.folder / f"{name}.txt").open("a") as said:
            code = subprocess.run([*OPENANT, *arguments], stdin=subprocess.DEVNULL, stdout=said, stderr=said).returncode
        if code:
            print(f"{self.name}: {name} ended with {code}, see {said.name}", file=sys.stderr, flush=True)

    # ---- the hour ----

    def _learn(self, run: Path, ready: Path, arguments: Sequence[str]) -> None:
        """Train until the hour is over; do what the script says, and help where someone is needed."""
        control = VirtualControl(json.loads(ready.read_text())["control"])
        said = (self.folder / "train.txt").open("a")
        starts: Callable[[], subprocess.Popen[bytes]] = lambda: subprocess.Popen(  # noqa: E731
            [*OPENANT, *arguments], stdin=subprocess.DEVNULL, stdout=said, stderr=said
        )
        process, script = starts(), _Script(self, control)
        began, started, hopeless, put_at = 0.0, time.monotonic(), 0, 0.0
        try:
            while not began or time.monotonic() - began < 60.0 * self.minutes:
                time.sleep(0.25)
                now = time.monotonic()
                if not began and any((run / "recordings").glob("*.mcap")):
                    began = now
                if began:
                    script.go_on(now - began, process)
                if process.poll() is not None and not script.unplugged:
                    hopeless = hopeless + 1 if now - started < HELP_S + 5.0 else 0
                    if hopeless == HOPELESS:
                        sys.exit(f"{self.name}: the command ends at once, see {said.name}")
                    time.sleep(HELP_S)
                    self._help(control, run, now - began if began else 0.0)
                    process, started = starts(), time.monotonic()
                elif began and now - put_at > UNSEEN_S and self._unseen(run):
                    put_at = now
                    control.ask("put")
                    self.help.append({"at_s": round(now - began, 1), "why": "out of the camera's view", "hands": True})
        finally:
            script.end()
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(120.0)
                process.kill()
            process.wait()
            control.close()
            said.close()

    def _help(self, control: VirtualControl, run: Path, at_s: float) -> None:
        """The builder's word after an end, with hands where the robot needs them."""
        lines, _ = read_log(run)
        why = lines[-1].words if lines and lines[-1].words.startswith("ended: ") else "ended: killed"
        hands = any(word in why for word in HANDS)
        if hands:
            control.ask("put")
        self.help.append({"at_s": round(at_s, 1), "why": why.removeprefix("ended: "), "hands": hands})

    def _unseen(self, run: Path) -> bool:
        """Whether the camera has not seen the robot for longer than by the script."""
        lines, _ = read_log(run)
        waits = [line for line in lines[-3:] if line.words.startswith("waiting: the camera does not see")]
        return bool(waits) and lines[-1] == waits[-1] and time.time() - waits[-1].at > UNSEEN_S


class _Script:
    """Faults that begin and end by the clock of the hour."""

    def __init__(self, hour: Hour, control: VirtualControl) -> None:
        self._hour, self._control = hour, control
        self._due = list(FAULTS)
        self._on: list[tuple[float, ScriptedFault]] = []
        self._busy: list[subprocess.Popen[bytes]] = []

    @property
    def unplugged(self) -> bool:
        return any(fault.request.get("cause") == "usb_unplug" for _, fault in self._on)

    def go_on(self, at_s: float, process: subprocess.Popen[bytes]) -> None:
        """What is due at `at_s` of the hour begins, and what has lasted ends."""
        while self._due and at_s >= self._due[0].share * 60.0 * self._hour.minutes:
            fault = self._due.pop(0)
            self._hour.happened.append({"at_s": round(at_s, 1), "what": fault.name, "seconds": fault.seconds})
            if fault.request:
                self._control.ask("fault", on=True, **fault.request)
            elif fault.seconds:
                spin = [sys.executable, "-c", "while True: pass"]
                self._busy = [subprocess.Popen(spin) for _ in range(os.cpu_count() or 1)]
            elif process.poll() is None:
                process.kill()
            self._on.append((at_s + fault.seconds, fault))
        for until, fault in [one for one in self._on if one[0] <= at_s]:
            self._on.remove((until, fault))
            self._off(fault)

    def end(self) -> None:
        """All of it ends."""
        with contextlib.suppress(OpenAntError):
            for _, fault in self._on:
                self._off(fault)
        self._on = []
        for one in self._busy:
            one.kill()
            one.wait()
        self._busy = []

    def _off(self, fault: ScriptedFault) -> None:
        if fault.request:
            like = {key: value for key, value in fault.request.items() if key in ("cause", "where")}
            self._control.ask("fault", on=False, **like)
        elif fault.seconds:
            for one in self._busy:
                one.kill()
                one.wait()
            self._busy = []


COLUMNS = (
    "run",
    "cm/s",
    "stepped cm/s",
    "share",
    "evaluated cm/s",
    "steps late",
    "by itself",
    "help",
    "virtual robot's processors",
)


def table(found: Sequence[Mapping[str, Any]]) -> str:
    """The summaries as Markdown."""

    def cm_s(part: Any) -> float | None:
        value = None if part is None else part["average_reward_m_s"]
        return None if value is None else 100.0 * value

    rows = []
    for one in found:
        page, mine, reference = one["page"], cm_s(one["page"]), cm_s(one["reference"])
        late = page["late"] / page["steps"] if page and page["steps"] else None
        share = mine / reference if mine is not None and reference is not None and reference > 0.0 else None
        cells: list[tuple[Any, str]] = [
            (mine, ".1f"), (reference, ".1f"), (share, ".2f"), (cm_s(one["eval"]), ".1f"),
            (late, ".1%"), (page and page["by_itself"], "d"), (len(one["help"]), "d"),
            (page and page["processors_of_virtual_robot"], ".2f"),
        ]  # fmt: skip
        shown = [f"{value:{form}}" if value is not None else "–" for value, form in cells]
        rows.append(f"| {one['agent']} {one['seed']} | " + " | ".join(shown) + " |")
    head = [f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    return "\n".join([*head, *rows]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=float, default=60.0)
    length.add_argument("--hours", type=float)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--agents", nargs="+", choices=list(HOUR_STEPS), default=list(HOUR_STEPS))
    parser.add_argument("--at-once", type=int, default=1, help="runs at a time")
    options = parser.parse_args()
    minutes = options.minutes if options.hours is None else 60.0 * options.hours
    hours = [
        Hour(agent, seed, (options.out / f"{agent}-{seed}").resolve(), minutes)
        for seed in options.seeds for agent in options.agents
    ]  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)

    def one(hour: Hour) -> None:
        if hour.summary.is_file():
            return
        hour.do()
        done = [json.loads(other.summary.read_text()) for other in hours if other.summary.is_file()]
        write_text(options.out / "hours.md", table(done))
        print(f"{hour.name} is done: {len(done)} of {len(hours)}", flush=True)

    with ThreadPoolExecutor(options.at_once) as pool:
        list(pool.map(one, hours))
    print(table([json.loads(hour.summary.read_text()) for hour in hours]))


if __name__ == "__main__":
    main()
