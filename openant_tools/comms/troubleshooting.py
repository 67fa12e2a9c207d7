"""`docs/troubleshooting.md`, from the tables that the program takes its words from.

python -m openant_tools.comms.troubleshooting > docs/troubleshooting.md
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from openant_tools.comms.dropouts.causes import CAUSES
from openant_tools.comms.faults import REFUSALS
from openant_tools.comms.silence import LEVELS
from openant_tools.comms.troubles import PORT, SILENCE, Trouble
from openant_tools.robot.servo import HARDWARE_ERRORS

__all__ = ["page"]

#: what stands in the words' fields on the page
EXAMPLE: Mapping[str, object] = {
    "who": "knee_fl (id 31)", "late": "this computer was late by up to 41 ms in 7 % of cycles", "port": "/dev/ttyUSB0",
    "after": "48 ms", "error": "overload", "advice": HARDWARE_ERRORS[-1].advice, "id": 31, "level": 1, "answers": LEVELS[1],
    "baud": 57600, "speed": "1000000 baud", "volts": "5.1 V", "range": "6.5 to 14.8 V", "count": 13, "seconds": "0.79 s",
    "before": "hip_fl", "first": "knee_fl", "other": "/dev/serial/by-id/usb-FTDI…", "group": "dialout",
}  # fmt: skip
_READER: Mapping[str, object] = {"who": "python monitor.py (process 4711)"}
_CLOSED: Mapping[str, object] = {**EXAMPLE, **_READER, "error": "Input/output error"}
_HEAD = """# Troubleshooting

What you see, what the program says, what it means, what to do. This page is made from the tables that the program takes its
words from (`python -m openant_tools.comms.troubleshooting`); the examples speak of one robot, yours has its own names.

`openant comms scan` asks who is there and, with `--id N`, why one is silent. `openant comms watch` shows losses live.
`openant comms soak` and `openant comms diagnose` find out what loses answers now and then.

In doubt about these tools? `openant comms scan --driver sdk`, `openant comms watch --driver sdk` and `openant calib inventory
--driver sdk` ask with the vendor's own DynamixelSDK: where it meets the same silence, the bus or the servo is silent.

- [A servo, or the whole bus, is silent](#a-servo-or-the-whole-bus-is-silent)
- [Answers are lost now and then](#answers-are-lost-now-and-then)
- [A servo has switched itself off](#a-servo-has-switched-itself-off): its LED blinks
- [A servo says no](#a-servo-says-no)
- [A port does not open](#a-port-does-not-open)

## Reference
"""
_SILENCE = """### A servo, or the whole bus, is silent

In this order: the cable is named only when all before it was excluded. Nothing is written while asking.
"""
_LOST = """### Answers are lost now and then

What `openant comms diagnose` tells apart in recordings and soaks. A loss in a cycle in which this computer was late counts
against the computer, never against a cable.
"""


def page() -> str:
    """The page, as Markdown."""
    parts = [
        _HEAD,
        _SILENCE,
        _table(("you see", "it says", "it means", "do"), (_row(one, EXAMPLE) for one in SILENCE.values())),
        _LOST,
        _table(
            ("cause", "it says", "do", "to make sure"),
            (
                (f"`{name}`", cause.words, cause.remedy.format(**EXAMPLE), cause.test.format(**EXAMPLE))
                for name, cause in CAUSES.items()
            ),
        ),
        "### A servo has switched itself off\n\nIts LED blinks, and torque cannot be switched on. `openant comms scan` shows "
        "it, `openant comms reboot` says which error it is, and refuses while its cause stands.\n",
        _table(("error", "what it means, and what to do"), ((one.name, one.advice) for one in HARDWARE_ERRORS)),
        "### A servo says no\n",
        _table(("it refuses because", "do"), REFUSALS.values()),
        "### A port does not open\n",
        _table(("you see", "it says", "it means", "do"), (_row(one, _CLOSED) for one in PORT.values())),
    ]
    return "\n".join(parts)


def _row(trouble: Trouble, example: Mapping[str, object]) -> tuple[str, ...]:
    values = {**example, **(_READER if "program" in trouble.says else {})}
    return trouble.symptom, trouble.says.format(**values), trouble.means, trouble.do.format(**values)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = tuple(head)
    lines = [head, ("---",) * len(head), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


if __name__ == "__main__":
    print(page(), end="")
