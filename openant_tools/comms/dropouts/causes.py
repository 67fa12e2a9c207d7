"""The causes of lost communication (formats, section 7): what each does to every mark, its remedy, its test.

Each mark of `measures` is a number in 0…1, and under each cause it has a Beta density; what a cause leaves open has the
broad one of `OTHERWISE`. They are read off the physics (a pulled USB plug resets no servo, noise breaks bytes and dips
no voltage), and were checked on soaks from two simulators; docs/comms-blind.md has the outcome.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["CAUSES", "OTHERWISE", "DropoutCause", "Spread", "separating_test"]

#: a, b of a Beta density
Spread = tuple[float, float]


@dataclass(frozen=True)
class DropoutCause:
    """One explanation.

    Attributes:
        words: what it is, for a sentence. remedy: what ends it. test: what shows it, or rules it out; in both `{who}` is
            the servo, or the servos, concerned.
        prior: how common among robots with trouble, relative.
        losses: probabilities of no loss, of a few stray ones, of real ones.
        reach: kind of `Reach` → probability.
        marks: mark → density under this cause.
    """

    words: str
    remedy: str
    test: str
    losses: tuple[float, float, float]
    reach: Mapping[str, float]
    marks: Mapping[str, Spread]
    prior: float = 1.0


#: mark → density where a cause has nothing to do with it
OTHERWISE: Mapping[str, Spread] = {
    "crc": (0.7, 3.0), "late": (0.35, 14.0), "port": (0.3, 40.0), "together": (1.0, 1.0), "rate": (0.5, 8.0),
    "single": (1.0, 1.0), "long": (1.0, 3.0), "dip": (0.35, 14.0), "sag": (0.6, 6.0), "reset": (0.3, 25.0),
    "angle": (0.45, 7.0), "load": (0.5, 6.0), "low": (0.5, 6.0), "motion": (0.5, 6.0), "stall": (0.35, 9.0), "host": (0.35, 14.0),
    "comb": (0.3, 18.0), "stairs": (0.3, 18.0), "gap": (0.35, 7.0), "baud": (1.0, 1.6), "often": (1.0, 1.0),
    "empty": (0.3, 20.0),
}  # fmt: skip
#: of a cause by which answers are lost: its `losses`, and its `reach` and silence where nothing says otherwise
_LOSES = (0.0006, 0.025, 0.975)
_ALL = {"all": 0.86, "behind": 0.04, "one": 0.02, "pair": 0.02, "scattered": 0.06}
_SILENT = (0.6, 12.0)

CAUSES: Mapping[str, DropoutCause] = {
    "power_connector": DropoutCause(
        "a power connector that loses contact",
        "take the barrel plug away and screw the supply's wires into the board's terminals",
        "wiggle the power plug, and each power connector, while `openant comms watch` runs",
        _LOSES,
        {"all": 0.67, "behind": 0.18, "one": 0.03, "pair": 0.03, "scattered": 0.09},
        {
            "crc": (0.7, 7.0), "together": (4.0, 1.0), "rate": (0.45, 10.0), "single": (0.8, 1.0), "long": (1.4, 2.4),
            "dip": (0.7, 0.6), "reset": (0.7, 0.7), "sag": (0.6, 5.0), "load": (0.7, 3.0), "low": (1.0, 1.0), "motion": (0.8, 1.6),
            "angle": (0.6, 5.0),
        },
    ),
    "supply_weak": DropoutCause(
        "a supply, or its cable, too weak for the load",
        "use a supply of more current (12 V 8 A for the standard robot) and thicker, shorter cables",
        "hold the robot still in the air: losses that end then came of the load; measure the supply under load",
        _LOSES,
        {"all": 0.74, "behind": 0.06, "one": 0.03, "pair": 0.04, "scattered": 0.13},
        {
            "crc": (0.7, 6.0), "together": (2.0, 1.0), "rate": (0.4, 1.2), "single": (0.8, 1.2), "long": (1.2, 3.0),
            "dip": (0.8, 0.7), "empty": (0.5, 0.6), "reset": (0.6, 0.9), "sag": (2.2, 1.0), "load": (3.0, 0.9), "low": (3.5, 0.8), "motion": (0.8, 1.5),
            "angle": (0.8, 1.4),
        },
    ),
    "broken_wire": DropoutCause(
        "a wire that breaks at a joint's angle",
        "replace the cable that runs over {who}, and give it slack",
        "bend {who} slowly by hand with torque off while `openant comms watch` runs",
        _LOSES,
        {"all": 0.03, "behind": 0.43, "one": 0.44, "pair": 0.03, "scattered": 0.07},
        {
            "crc": (0.7, 3.0), "together": (2.0, 1.0), "rate": (0.7, 3.0), "single": (0.7, 1.3), "long": (1.2, 2.5),
            "dip": (0.35, 6.0), "reset": (0.35, 3.0), "angle": (4.5, 0.8), "load": (0.6, 1.8), "low": (0.5, 1.6), "motion": (0.6, 3.5),
        },
    ),
    "bad_servo": DropoutCause(
        "one bad servo, or its own connector",
        "press both plugs of {who} home, then replace it",
        "swap {who} with another servo of its model: does the loss go with it?",
        _LOSES,
        {"all": 0.01, "behind": 0.04, "one": 0.91, "pair": 0.01, "scattered": 0.03},
        {
            "crc": (1.0, 1.2), "rate": (0.6, 4.0), "single": (1.2, 0.9), "long": (0.7, 5.0), "reset": (0.35, 6.0),
            "dip": (0.35, 8.0),
        },
    ),
    "bad_cable": DropoutCause(
        "a bad cable or plug in the chain",
        "replace the cable that leads to {who}; press its plugs home",
        "wiggle the cable that leads to {who}, then swap it for another",
        _LOSES,
        {"all": 0.06, "behind": 0.77, "one": 0.1, "pair": 0.02, "scattered": 0.05},
        {
            "crc": (0.7, 1.4), "together": (1.8, 0.8), "rate": (0.6, 4.0), "single": (1.2, 1.0), "long": (0.8, 3.5),
            "reset": (0.35, 4.0), "dip": (0.35, 6.0), "motion": (0.6, 3.5),
        },
    ),
    "line_noise": DropoutCause(
        "noise on the line, or a missing termination",
        "keep motor and data cables apart, shorten the bus, and lower the baud rate",
        "record at half the baud rate: noise breaks fewer answers there",
        (0.0006, 0.06, 0.94),
        {"all": 0.86, "behind": 0.02, "one": 0.02, "pair": 0.02, "scattered": 0.08},
        {
            "crc": (4.0, 1.3), "together": (1.2, 3.5), "rate": (0.6, 6.0), "single": (3.0, 0.8), "long": (0.4, 14.0),
            "baud": (3.0, 1.0),
        },
    ),
    "return_delay": DropoutCause(
        "a return delay that servos still have from the factory",
        "set Return Delay Time (9) of {who} to 0: `openant calib ids` does",
        "`openant config check` reads register 9 of {who}",
        (0.45, 0.2, 0.35),
        {"all": 0.32, "behind": 0.2, "one": 0.22, "pair": 0.06, "scattered": 0.2},
        {"crc": _SILENT, "late": (0.7, 0.55), "stairs": (6.0, 0.6), "together": (1.5, 1.5), "comb": (0.35, 9.0)},
    ),
    "latency_timer": DropoutCause(
        "the adapter's latency timer of 16 ms",
        "set it to 1 ms: `openant comms ports` prints the udev rule",
        "`openant comms ports` shows the timer of each adapter",
        (0.5, 0.15, 0.35),
        {"all": 0.72, "behind": 0.1, "one": 0.05, "pair": 0.03, "scattered": 0.1},
        {
            "crc": _SILENT, "late": (0.7, 0.55), "comb": (6.0, 0.6), "together": (2.0, 1.0), "stall": (0.35, 4.0),
            "stairs": (0.35, 6.0),
        },
    ),
    "host_stall": DropoutCause(
        "a host that stands still now and then",
        "close what competes for the processor, switch off power saving, and record from a process of its own",
        "run `openant comms soak` with nothing else running, and look at `wake`",
        (0.5, 0.15, 0.35),
        _ALL,
        {
            "crc": _SILENT, "late": (0.6, 0.6), "stall": (6.0, 0.6), "host": (2.5, 0.8), "together": (3.0, 1.0),
            "rate": (0.4, 14.0), "single": (0.8, 1.0), "long": (1.0, 3.0),
        },
    ),
    "usb_unplug": DropoutCause(
        "a USB plug that came loose",
        "fix the USB plug with a strap or screws, and use a shorter cable without a hub",
        "wiggle the USB plug; `dmesg -w` says when the adapter goes and comes",
        _LOSES,
        {"all": 0.97, "behind": 0.01, "one": 0.005, "pair": 0.005, "scattered": 0.01},
        {
            "crc": (0.35, 25.0), "port": (0.5, 0.35), "together": (14.0, 0.5), "rate": (0.5, 6.0), "single": (0.5, 5.0),
            "long": (3.5, 2.0), "often": (1.2, 3.5), "stall": (0.35, 2.5), "host": (0.35, 5.0),
        },
    ),
    "duplicate_id": DropoutCause(
        "two servos with one id",
        "plug {who} in alone, one servo after the other, and give each its own id: `openant calib ids`",
        "`openant comms scan` with {who} plugged in alone, one servo after the other",
        _LOSES,
        {"all": 0.02, "behind": 0.18, "one": 0.14, "pair": 0.6, "scattered": 0.06},
        {
            "crc": (1.8, 1.4), "together": (2.5, 0.8), "rate": (3.0, 0.7), "single": (0.6, 1.6), "long": (1.5, 1.2),
            "baud": (1.0, 1.6),
        },
    ),
    "write_read_gap": DropoutCause(
        "reads that follow a write too closely",
        "leave 1 ms between the end of a write and the next read (bus.write_read_gap_s in robot.toml)",
        "`openant comms bench` measures the gap that the servos need",
        _LOSES,
        {"all": 0.93, "behind": 0.01, "one": 0.01, "pair": 0.01, "scattered": 0.04},
        {
            "crc": (0.35, 16.0), "gap": (3.0, 0.7), "together": (12.0, 0.6), "rate": (0.9, 1.5), "single": (2.0, 0.9),
            "long": (0.5, 6.0),
        },
    ),
}  # fmt: skip

#: of two causes; `{cause}` is the servo, or the servos, that this cause is suspected at
_TESTS: Mapping[frozenset[str], str] = {
    frozenset(("bad_servo", "bad_cable")): "swap the cable that leads to {bad_cable} first, then the servo of {bad_servo}: "
    "whichever the loss goes with",
    frozenset(("bad_servo", "broken_wire")): "bend {broken_wire} slowly by hand with torque off, and keep still in between: "
    "a broken wire follows the angle, a bad servo does not",
    frozenset(("bad_cable", "broken_wire")): "bend {broken_wire} slowly by hand with torque off, and keep still in between: "
    "a broken wire follows the angle, a bad plug does not",
    frozenset(("power_connector", "supply_weak")): "hold a heavy load without shaking, then shake without load: "
    "a weak supply follows the load, a loose connector the shaking",
    frozenset(("power_connector", "usb_unplug")): "look at the servos' LEDs: they blink after a loss of power, not of USB",
    frozenset(("power_connector", "bad_cable")): "read the realtime ticks of {bad_cable}: power that went resets them, data "
    "does not",
    frozenset(("host_stall", "usb_unplug")): "`dmesg -w` says when the adapter goes and comes",
    frozenset(("line_noise", "bad_cable")): "record at half the baud rate: noise breaks fewer answers there",
    frozenset(("line_noise", "bad_servo")): "unplug {bad_servo}: noise stays with the others",
    frozenset(("write_read_gap", "line_noise")): "leave 1 ms between write and read: only the gap is cured by that",
    frozenset(("duplicate_id", "bad_servo")): "`openant comms scan` with {bad_servo} alone on the cable",
    frozenset(("duplicate_id", "bad_cable")): "`openant comms scan` with {duplicate_id} plugged in alone, one servo after "
    "the other: two with one id show as one",
}  # fmt: skip


def separating_test(one: str, other: str, who: Mapping[str, str]) -> str:
    """What to do to tell two causes apart; `who`: cause → the servo, or the servos, that it is suspected at."""
    own = _TESTS.get(frozenset((one, other)))
    if own is not None:
        return own.format(**who)
    return "; ".join(CAUSES[cause].test.format(who=who[cause]) for cause in (one, other))
