"""How late the engine's loop wakes beside a terminal program that redraws eight plots, and beside nothing.

The engine is a process of its own, on a virtual robot in real time, with the legs moving; the screen is a Textual
program, without a terminal but rendering every line, in this process. "wake" is how late a cycle begins.

    python benchmarks/engine_jitter.py [--seconds 10] [--json FILE]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.segment import Segment
from textual.app import App, ComposeResult
from textual.strip import Strip
from textual.widget import Widget

from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.setup import config_of_unknown_robot
from openant_tools.robot.kit import home_angles
from openant_tools.virtual.process import virtual_robot

HOME = np.array(home_angles())
FRAMES_HZ = 20
BRAILLE = 0x2800


class Plot(Widget):
    """One joint's angle over the last seconds in braille, drawn anew each time: as heavy as a screen gets."""

    DEFAULT_CSS = "Plot { height: 1fr; }"

    def __init__(self) -> None:
        super().__init__()
        self.values = np.zeros(400)

    def render_line(self, y: int) -> Strip:
        width, height = max(1, self.size.width), max(1, self.size.height)
        points = np.interp(np.linspace(0, len(self.values) - 1, 2 * width), np.arange(len(self.values)), self.values)
        rows = ((0.5 - points / 3) * 4 * height).astype(int)
        dots = (0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80)
        cells = []
        for x in range(width):
            code = BRAILLE
            for side in (0, 1):
                row = rows[2 * x + side] - 4 * y
                if 0 <= row < 4:
                    code |= dots[side][row]
            cells.append(chr(code))
        return Strip([Segment("".join(cells))])


class Screen(App[None]):
    """Eight plots of an engine's telemetry, redrawn `FRAMES_HZ` times a second for a while."""

    def __init__(self, engine: EngineProcess, seconds: float) -> None:
        super().__init__()
        self._engine, self._seconds = engine, seconds
        self.rows: list[Any] = []
        self.frames = 0

    def compose(self) -> ComposeResult:
        for _ in range(8):
            yield Plot()

    def on_mount(self) -> None:
        self._columns = [k for k, name in enumerate(self._engine.columns) if name.startswith("pos.")]
        self.set_interval(1 / FRAMES_HZ, self._draw)
        self.set_timer(self._seconds, self.exit)

    def _draw(self) -> None:
        rows = self._engine.telemetry()
        self.rows.extend(rows)
        self.frames += 1
        for plot, column in zip(self.query(Plot), self._columns, strict=True):
            plot.values = np.concatenate([plot.values, np.nan_to_num(rows[:, column])])[-400:]
            plot.refresh()


def lateness(rows: list[Any], columns: list[str]) -> dict[str, float]:
    """Quantiles of `wake`, and the spread of the cycle's period, s."""
    table = np.array(rows)
    wake, t = table[:, columns.index("wake")], table[:, columns.index("t")]
    return {
        "cycles": len(table), "wake_p50_s": float(np.median(wake)), "wake_p99_s": float(np.quantile(wake, 0.99)),
        "wake_max_s": float(wake.max()), "period_std_s": float(np.diff(t).std()),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results: dict[str, list[dict[str, float]]] = {"no screen": [], "eight plots at 20 Hz": []}
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        scenario = Path(folder) / "scenario.toml"
        scenario.write_text("[camera]\npresent = false\n")
        with virtual_robot(str(scenario), clock="real") as ready:
            config = replace(config_of_unknown_robot(str(ready["bus"]), str(ready["control"])))
            with EngineProcess(config) as engine:
                engine.ask(messages.Torque(True))
                wave = HOME + 0.2 * np.sin(2 * np.pi * np.arange(60_000) / 100)[:, None]
                engine.start(messages.Play(wave))
                time.sleep(2.0)
                for _ in range(options.rounds):
                    engine.telemetry()
                    rows: list[Any] = []
                    end = time.monotonic() + options.seconds
                    while time.monotonic() < end:
                        time.sleep(0.5)
                        rows.extend(engine.telemetry())
                    results["no screen"].append(lateness(rows, engine.columns))
                    screen = Screen(engine, options.seconds)
                    asyncio.run(screen.run_async(headless=True, size=(160, 48)))
                    results["eight plots at 20 Hz"].append(lateness(screen.rows, engine.columns))
                engine.stop()
    table = []
    print("| beside | cycles | wake p50 | wake p99 | latest | period σ |\n|---|---|---|---|---|---|")
    for name, rounds in results.items():
        row = {key: statistics.median(one[key] for one in rounds) for key in rounds[0]}
        table.append(row | {"beside": name})
        times = " | ".join(
            f"{row[key] * 1e3:.2f} ms" for key in ("wake_p50_s", "wake_p99_s", "wake_max_s", "period_std_s")
        )
        print(f"| {name} | {row['cycles']:.0f} | {times} |")
    print(f"\nload {load:.1f} before, {os.getloadavg()[0]:.1f} after, on {os.cpu_count()} cores")
    if options.json:
        options.json.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
