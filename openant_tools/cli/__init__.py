"""The `openant` command: parsing and printing only. Every command's work is done by the room it belongs to."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import logging
import os
import sys
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path

import click

from openant_tools.cli.leaving import heed_signals
from openant_tools.cli.log import begin, log_options
from openant_tools.cli.streams import has_terminal, open_closed_streams
from openant_tools.errors import OpenAntError, system_fault
from openant_tools.opengl import load_no_window_library
from openant_tools.trust import TRUST, trusted
from openant_tools.workers import end_with_who_started_us

__all__ = ["main"]

# command → (module of this package, section of the manual, one line of help). A module is imported only when its
# command is used, so that `openant --help` answers at once.
COMMANDS: dict[str, tuple[str, str, str]] = {
    "demo": ("demo", "Start here", "The whole way on a virtual robot: record, identify, learn, report."),
    "virtual": ("virtual", "Robot", "A virtual Open Ant that speaks the real protocols."),
    "bringup": ("bringup", "Robot", "From loose motors to a robot with a passport, step by step."),
    "calib": ("calib", "Robot", "Bring a robot up, step by step: ids, centring, zeros, bounds, IMU, arena; undo."),
    "check": ("check", "Robot", "Two minutes before a session: is the robot as its passport has it?"),
    "passport": ("passport", "Robot", "One page with everything known about a robot."),
    "config": ("config", "Robot", "Check, show, import and export the robot's configuration."),
    "servo": ("servo", "Robot", "Gains of a servo: registers as numbers of an MJCF, and back."),
    "comms": ("comms", "Robot", "The bus: scan, watch, measure."),
    "thermal": ("thermal", "Robot", "Heat: soak the robot, fit its heat, forecast shutdowns, compare."),
    "rec": ("rec", "Data", "Recordings: info, repair, export, import, view."),
    "sysid": ("sysid", "Data", "Record excitations and fit a calibrated model to them."),
    "gap": ("gap", "Data", "How far a simulation is from its robot, and where."),
    "train": ("train", "Learning", "Train an agent to walk, in simulation."),
    "eval": ("eval", "Learning", "Play a trained agent and measure its reward per second."),
    "plot": ("plot", "Learning", "Learning curves of several runs in one picture."),
    "policies": ("policies", "Learning", "Which simulation ranks policies as the robot does, and which fool it."),
    "loop": ("loop", "Learning", "From simulation to robot and back, beside a control: what improving it is worth."),
    "tune": ("tune", "Learning", "Search for settings of an agent, on as many machines as you like."),
    "support": ("support", "Help", "One bundle for a bug report: versions, ports, config, findings, log."),
}

INTERRUPTED = 130

_log = logging.getLogger(__name__)


def common_options(command: click.Command) -> click.Command:
    """Give a command, or each of a group's, `-v`, `-q`, and `--trust-paths` where it reads files that may name others."""
    names = {parameter.name for parameter in command.params}
    if isinstance(command, click.Group):
        for one in command.commands.values():
            common_options(one)
        return command
    if "verbose" not in names:
        command.params.extend(log_options())
    if "trust_paths" not in names and names & {"model", "robot", "run", "runs"}:
        words = "Follow absolute paths and links in files, wherever they lead."
        option = ["--trust-paths"]
        command.params.append(
            click.Option(option, is_flag=True, is_eager=True, expose_value=False, callback=_trust, help=words)
        )
    return command


def _trust(context: click.Context, option: click.Parameter, value: bool) -> None:
    if value and not trusted():
        os.environ[TRUST] = "1"
        context.call_on_close(lambda: os.environ.pop(TRUST, None))


class Manual(click.Group):
    """The top-level group: imports a command's module on use and lists commands by section."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"openant_tools.cli.{COMMANDS[cmd_name][0]}")
        command = getattr(module, "eval_" if cmd_name == "eval" else cmd_name)
        assert isinstance(command, click.Command)
        return common_options(command)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        unknown = not args[0].startswith("-") and self.get_command(ctx, args[0]) is None
        if unknown and not ctx.resilient_parsing:
            near = difflib.get_close_matches(args[0], COMMANDS, n=3)
            meant = f". Did you mean {' or '.join(map(repr, near))}?" if near else ""
            raise click.UsageError(f"No such command {args[0]!r}{meant}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        sections: dict[str, list[tuple[str, str]]] = {}
        for name, (_, section, line) in COMMANDS.items():
            sections.setdefault(section, []).append((name, line))
        for section, rows in sections.items():
            with formatter.section(section):
                formatter.write_dl(rows)


@click.group(
    cls=Manual,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Each command explains itself: `openant sysid fit --help`. Exit codes: 0 done, 1 a finding that says no, "
    "2 bad input or no hardware, 130 interrupted.",
)
@click.version_option(package_name="openant-tools", prog_name="openant")
@click.option("--robot", type=click.Path(path_type=Path), metavar="DIR", help="The terminal program's robot.")
@click.option(
    "--virtual", "virtual_source", is_flag=False, flag_value="default", metavar="[SCENARIO|READY_FILE]",
    help="Begin the terminal program with a virtual robot.",
)  # fmt: skip
@click.option(
    "--serve", "port", type=click.IntRange(1, 65535), is_flag=False, flag_value=8000, metavar="[PORT]",
    help="Show the terminal program in a browser, at http://localhost:8000.",
)  # fmt: skip
@click.pass_context
def openant(context: click.Context, robot: Path | None, virtual_source: str | None, port: int | None) -> int | None:
    """Open Ant Tools: from a box of parts to a robot that learns, and a simulation of it that you can trust.

    \b
    Without a command, in a terminal:
      openant                                        the terminal program: the walk from loose motors to learning
    \b
    First success, without any hardware:
      openant demo                                   the whole way on a virtual robot, in minutes
    \b
    The same, step by step:
      openant virtual start --ready-file robot.json  a virtual Open Ant on pseudo-terminals
      openant sysid record --virtual robot.json --protocol stand --out run.mcap
      openant sysid fit run.mcap --model my-ant/nominal.xml --out fit
      openant train sac --robot my-ant --steps 30000 --out my-ant/runs/sac
    """
    if context.invoked_subcommand is not None:
        if robot is not None or virtual_source is not None or port is not None:
            raise click.UsageError("--robot, --virtual and --serve before a command are for none: give them after it")
        return None
    # A browser's server runs this program with a driver of its own, and pipes.
    shown = has_terminal("stdin", "stdout") or "TEXTUAL_DRIVER" in os.environ
    if port is None and not shown:
        raise click.exceptions.NoArgsIsHelpError(context)
    from openant_tools.cli import terminal

    if port is not None:
        return terminal.serve(port, robot, virtual_source)
    return terminal.terminal(robot, virtual_source)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line; exits with 0, 1, 2 or 130 (formats, section 6), never a traceback for bad input."""
    open_closed_streams()
    heed_signals()
    end_with_who_started_us()
    begin(list(sys.argv[1:] if argv is None else map(str, argv)))
    load_no_window_library()
    try:
        code = openant.main(args=argv, prog_name="openant", standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except OpenAntError as error:
        click.echo(f"openant: {error}", err=True)
        _log.info("ended: %s", error)
        sys.exit(error.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(2)
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "openant"
        words = " ".join(error.format_message().split())
        click.echo(f"{command}: {words.removesuffix('.')} → `{command} --help` says what it takes", err=True)
        sys.exit(2)
    except OSError as error:
        click.echo(f"openant: {system_fault(error)}", err=True)
        sys.exit(2)
    except BrokenExecutor:
        click.echo(
            "openant: a process that did a part of this was killed; memory may be short → close other programs, and "
            "run the command again",
            err=True,
        )
        _log.info("a process was killed", exc_info=True)
        sys.exit(1)
    except (KeyboardInterrupt, click.Abort):
        with contextlib.suppress(OSError):  # the terminal may be what has gone
            click.echo("openant: interrupted", err=True)
        sys.exit(INTERRUPTED)
    except (
        Exception
    ):  # a fault of the program: its traceback goes to stderr as ever, and where `openant support` finds it
        _log.info("a fault of the program", exc_info=True)
        raise


openant.params.extend(log_options())
