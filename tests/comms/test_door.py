"""Whatever switches torque on is guarded: every command that moves, and each process of it killed while it holds."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click
import pytest
from killing import (
    ELSEWHERE,
    OFF_S,
    WAYS,
    InLine,
    NotBegun,
    Victim,
    children,
    moving_commands,
    torque_after_kill,
)

from openant_tools.cli.hardware import may_move
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.messages import EngineConfig
from openant_tools.errors import BadInput
from openant_tools.virtual.process import virtual_robot


def test_every_command_that_moves_says_how_it_is_begun_here() -> None:
    assert sorted(moving_commands()) == sorted([*WAYS, *ELSEWHERE])


def test_a_command_that_moves_without_being_declared_cannot() -> None:
    @click.command()
    def sneaky() -> None:
        may_move(yes=True)

    with pytest.raises(RuntimeError, match="`sneaky` moves: it must be a `Moving` command"):
        sneaky.main([], prog_name="sneaky", standalone_mode=False)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="processes are found by /proc")
def test_a_killed_process_of_any_command_that_moves_leaves_torque_off(tmp_path: Path) -> None:
    """Each loses its guardian, who is replaced, and then its engine or itself; benchmarks/reliability_door.py does all, with
    those that take longest, and kills guardian and engine together."""

    def kill(k: int, name: str) -> dict[Victim, float]:
        victims: tuple[Victim, ...] = ("guardian", "command" if k % 2 else "engine")
        # On a busy computer a watchdog may trip first, or those who are to act may stand in line: that tells nothing.
        for tries in (2, 1, 0):
            folder = tmp_path / f"{name.replace(' ', '-')}-{tries}"
            folder.mkdir()
            try:
                return torque_after_kill(name, victims, folder)
            except NotBegun:
                if not tries:
                    raise
        raise AssertionError

    # Those that wait longest for hands begin first.
    ways = sorted((name for name, way in WAYS.items() if not way.campaign), key=lambda name: name != "bringup")
    with ThreadPoolExecutor(4) as pool:
        took = dict(zip(ways, pool.map(kill, range(len(ways)), ways), strict=True))
    late = {name: times for name, times in took.items() if max(times.values()) > OFF_S}
    assert not late, took


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf"), 0.01, 3.0])
def test_a_watchdog_that_would_not_guard_is_refused_where_something_moves(seconds: float) -> None:
    with pytest.raises(BadInput, match=r"Bus Watchdog \(watchdog_s\) .* give it 0.02 to 2.54 s"):
        EngineConfig("/dev/null", (), watchdog_s=seconds)
    assert EngineConfig("/dev/null", (), watchdog_s=0.0, still=True).still


HOLDING = textwrap.dedent(
    """
    import signal, sys
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # tests may run under nohup, which the program heeds
    from openant_tools.cli import main, openant
    from openant_tools.cli.hardware import Moving, engine_config, may_move
    from openant_tools.comms import messages
    from openant_tools.comms.engine_process import EngineProcess

    @openant.command("hold", cls=Moving)
    def hold():
        may_move(True)
        with engine_config(None, sys.argv[2], sys.argv[3]) as config, EngineProcess(config) as engine:
            engine.ask(messages.Torque(True))
            engine.ask(messages.Hold(300.0))

    type(openant).get_command = lambda self, context, name: self.commands[name]
    main(["hold"])
    """
)
#: the same, where whoever waits is told that it is interrupted and waits on
DEAF = (
    HOLDING.replace(
        """        engine.ask(messages.Torque(True))
        engine.ask(messages.Hold(300.0))
""",
        """        _, held = engine.start(messages.Torque(True)), engine.start(messages.Hold(300.0))
        while True:
            try:
                engine.wait(held)
            except KeyboardInterrupt:
                pass
""",
    )
    .replace("import main", "import leaving, main")
    .replace("main([", "leaving.ENDED_S = 1.0\nmain([")
)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="a suspended parent is seen by /proc")
def test_suspension_and_a_lost_terminal_end_motion_first(tmp_path: Path) -> None:
    (tmp_path / "stand.toml").write_text("[camera]\npresent = false\n")
    with virtual_robot(str(tmp_path / "stand.toml"), clock="real", camera=False) as found:
        control = VirtualControl(str(found["control"]))
        ready = tmp_path / "ready.json"
        ready.write_text(json.dumps(dict(found)))

        def torque() -> bool:
            return any(control.ask("state")["torque_enable"].values())

        class Busy(Exception):
            """This computer was too busy to tell."""

        def tried(end: Callable[[subprocess.Popen[bytes]], None], codes: tuple[int, ...], program: str) -> None:
            """Begin to hold, end it so, and see that torque goes off within two seconds."""
            log = tmp_path / "log"
            words = [sys.executable, "-c", program, "hold", str(found["bus"]), str(ready)]
            with log.open("wb") as err, subprocess.Popen(words, stdout=subprocess.PIPE, stderr=err) as process:
                try:
                    give_up = time.monotonic() + 60.0
                    while not torque():
                        if process.poll() is not None and b"this computer was late" in log.read_bytes():
                            raise Busy
                        assert process.poll() is None, log.read_text()
                        assert time.monotonic() < give_up
                        time.sleep(0.01)
                    waited = InLine([*children(process.pid), *children(os.getpid())])
                    begin = time.monotonic()
                    end(process)
                    while torque():
                        took = time.monotonic() - begin
                        waited.look()
                        if took > 2.0 + waited.seconds:
                            said = log.read_text()
                            raise AssertionError(
                                f"torque is on after {took:.2f} s, {waited.seconds:.2f} of them in line: {said}"
                            )
                        time.sleep(0.01)
                    if time.monotonic() - begin > 2.0:
                        raise Busy
                    os.kill(process.pid, signal.SIGCONT)
                    code = process.wait(30.0)
                    if code not in codes and b"this computer was late" in log.read_bytes():
                        raise Busy
                    assert code in codes, log.read_text()
                    assert not torque()
                finally:
                    process.kill()

        def unread(process: subprocess.Popen[bytes]) -> None:
            assert process.stdout is not None
            process.stdout.close()

        def suspended(number: int) -> Callable[[subprocess.Popen[bytes]], None]:
            return lambda process: os.kill(process.pid, number)

        for end, codes, program in (
            (suspended(signal.SIGTSTP), (130, 1, 2), HOLDING),  # it does not go on when it comes back
            (suspended(signal.SIGSTOP), (130, 1, 2), HOLDING),
            (unread, (130,), HOLDING),
            (unread, (1,), DEAF),
        ):
            for _ in range(3):
                try:
                    tried(end, codes, program)
                    break
                except Busy:
                    continue
            else:
                pytest.fail("this computer is too busy to tell")
        control.close()
