"""What the live strips cost, and whether the engine beside them notices: the program at 10 Hz on a virtual robot.

    python benchmarks/terminal_program.py [SECONDS]

Prints, for 80×24 and 120×40, the processor time of one redraw with all joints moving at 100 Hz (times ten is the share
of a core), and how late the engine's loop wakes while the strips are drawn and while nothing is. On a busy machine only
the former means anything.
"""

from __future__ import annotations

import asyncio
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from openant_tools.recording.run import Facts, Run
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.app import TICK_S, OpenAnt
from openant_tools.tui.feeds import ReplayFeed

WARM_UP_S = 12.0


async def redraw(size: tuple[int, int], ticks: int = 200) -> float:
    """Processor time of one tick with its redraw, s, less what waiting for it costs."""
    t = np.arange(0.0, 40.0, 0.01)
    columns = {f"pos.{joint}": 0.5 * np.sin(6 * t + k) for k, joint in enumerate(JOINT_NAMES)}
    now = 0.0
    app = OpenAnt(Path("."), ticking=False)
    async with app.run_test(size=size) as pilot:
        app.play(ReplayFeed(Run("swing", Facts(tuple(JOINT_NAMES)), t, columns), clock=lambda: now))
        for k in range(ticks + 100):
            if k == 100:  # a whole window of rows
                before = time.process_time()
            now += TICK_S
            app.tick()
            await pilot.pause()
        cost = time.process_time() - before
        before = time.process_time()
        for _ in range(ticks):
            await pilot.pause()  # what the harness itself costs
        return (cost - (time.process_time() - before)) / ticks


async def beside_an_engine(folder: Path, seconds: float) -> None:
    scenario = folder / "blind.toml"
    scenario.write_text("[camera]\npresent = false\n")
    app = OpenAnt(create_robot(folder / "ant").path, virtual=str(scenario))
    async with app.run_test(size=(120, 40)) as pilot:
        await pilot.press("c")
        while len(app.session.history.rows) < 100:
            await asyncio.sleep(0.1)
        await asyncio.sleep(WARM_UP_S)
        await report(app, "strips at 10 Hz", seconds)
        app.action_go("learn")
        await asyncio.sleep(1.0)
        await report(app, "no strips on the screen", seconds)
    app.session.close()


async def report(app: OpenAnt, what: str, seconds: float) -> None:
    wall, wakes = time.monotonic(), []
    while time.monotonic() - wall < seconds:
        await asyncio.sleep(1.0)
        t = app.session.history.t
        wakes.append(app.session.history.column("wake")[t > t[-1] - 1.0])
    late = 1e3 * np.nan_to_num(np.concatenate(wakes))
    print(
        f"{what}: the engine wakes {np.percentile(late, 50):.2f} ms late (median), {np.percentile(late, 99):.2f} ms (99 %)"
    )


if __name__ == "__main__":
    for size in ((80, 24), (120, 40)):
        cost = asyncio.run(redraw(size))
        print(f"{size[0]}×{size[1]}: {1e3 * cost:.1f} ms a redraw, {100 * cost / TICK_S:.1f} % of a core at 10 Hz")
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(beside_an_engine(Path(folder), float(sys.argv[1]) if len(sys.argv) > 1 else 20.0))
