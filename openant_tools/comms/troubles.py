"""What can be wrong between this computer and a servo, as data: the words that the program says and the page shows.

`docs/troubleshooting.md` is made of these tables (`comms.troubleshooting`), so that what stands there is what is said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["PORT", "SILENCE", "Trouble"]


@dataclass(frozen=True)
class Trouble:
    """One cause.

    Attributes:
        symptom: what the builder sees.
        says: the program's sentence, with {fields} for what was found. do: its remedy, with the same fields.
        means: why it is so.
    """

    symptom: str
    says: str
    means: str
    do: str


#: cause of silence → its words, in the order in which they are asked for: the cable comes last
SILENCE: Mapping[str, Trouble] = {
    "second_reader": Trouble(
        "servos answer now and then, or not at all; a scan finds other servos each time",
        "another program reads this port, {who}: it takes answers away",
        "each byte that comes goes to one reader only: a serial monitor, Dynamixel Wizard or a forgotten script gets some "
        "of the answers",
        "close that program first",
    ),
    "unseen_reader": Trouble(
        "servos answer now and then, or not at all; a scan finds other servos each time",
        "another program reads this port: answers came and were gone before they could be read",
        "as above, but the program is another user's or lives in a container, so that its name cannot be seen",
        "`sudo fuser -v {port}` names it; close it",
    ),
    "flood": Trouble(
        "nothing can be read although bytes come all the time",
        "the line never falls silent: {count} bytes that are no answer in {seconds} at {baud} baud",
        "something talks without being asked: another master on the bus, an IMU's port, a servo that broke, or noise",
        "something talks unasked: another program on this port, a wrong adapter, or an open wire that picks up noise; unplug "
        "the servos' cable: where it goes on, it is the adapter or this computer",
    ),
    "host_late": Trouble(
        "answers are lost, now here, now there, while this computer is busy",
        "{late}: what {who} answers comes too late, or is not seen",
        "the operating system did not let this program run when the answer came; neither servo nor cable has a part in it",
        "close what keeps this computer busy, and run it again",
    ),
    "late_answers": Trouble(
        "answers are called late or lost although every servo is well",
        "{who} answers after {after}, which is too late",
        "the adapter, a USB hub or a virtual machine holds answers back",
        "set the latency timer to 1 ms (`openant comms ports`), and plug the adapter in without a hub",
    ),
    "echo_only": Trouble(
        "nothing answers, but every byte that is sent comes back",
        "the adapter echoes what is sent, and no servo answers",
        "sending and receiving are joined on this adapter, and nobody else is heard on the line: no servo is on it, or it has "
        "no power",
        "is the supply on, and the first cable in? An adapter that sends and receives on one wire must switch between them",
    ),
    "hardware_error": Trouble(
        "a servo answers a ping, its LED may blink, and it neither moves nor takes torque",
        "{who} has switched itself off after {error}",
        "it protects itself until it is started again; what brought it there must end first",
        "{advice} (`openant comms reboot --port {port} --id {id}`)",
    ),
    "return_level": Trouble(
        "a servo answers pings and perhaps reads, but no write",
        "{who} has Status Return Level {level}: it answers {answers}",
        "register 68 stands in memory that forgets: other software has set it, and it stays so until power is cut",
        "`openant calib inventory` sets it to 2; or power it off and on",
    ),
    "protocol_1": Trouble(
        "a servo is silent at every baud rate, but other software finds it",
        "{who} speaks Protocol 1.0 at {baud} baud",
        "register 13 was set by other software; such a servo does not hear Protocol 2.0",
        "`openant calib inventory` sets register 13 back to 2; or Dynamixel Wizard does",
    ),
    "broadcast_short": Trouble(
        "a scan lists fewer servos than there are",
        "{who} answers when asked alone, and did not answer when all were asked: others may be missing, too",
        "answers to a broadcast ping come one after another, without being called: one was late, or two met on the line",
        "scan again; ask for what is missing by its id: `openant comms scan --id N`",
    ),
    "garbled_list": Trouble(
        "a scan lists fewer servos than there are",
        "{count} bytes that are no packet came among the answers at {baud} baud: others may be missing",
        "an answer to all was broken on its way: two servos with one id, noise, or a loose plug",
        "scan again; where it stays so, connect the servos one at a time",
    ),
    "still_coming": Trouble(
        "a scan lists fewer servos than there are",
        "answers at {baud} baud were still coming after {seconds}, when the time for the last id was over: others may be "
        "missing",
        "something delays the answers to a broadcast ping beyond what the vendor allows",
        "scan again; set the latency timer to 1 ms (`openant comms ports`), and plug the adapter in without a hub",
    ),
    "shared_id": Trouble(
        "one servo seems broken, and another is missing",
        "{who} answers, and every answer is garbled: two servos share the id, or its connector is loose",
        "both answer at the same time, and their bits mix",
        "unplug one of the two and give it its own id: `openant calib ids`; where there is only one, press its plugs home",
    ),
    "other_baud": Trouble(
        "a servo is silent at the robot's rate",
        "{who} answers at {baud} baud, not at {speed}",
        "its baud rate was left there by other software, or it is new: the factory sets 57600",
        "`openant calib inventory` sets it",
    ),
    "supply": Trouble(
        "some or all servos are silent",
        "{who} is silent, and those that answer are supplied with {volts}: they need {range}",
        "a servo below its voltage does not start",
        "look at the power connector and at the supply",
    ),
    "intermittent": Trouble(
        "a servo is lost for moments",
        "{who} was silent a moment ago and answers now",
        "something loses contact for moments: a plug, a wire over a joint, the supply under load",
        "`openant comms soak` while the legs move, then `openant comms diagnose`, says which",
    ),
    "nobody": Trouble(
        "no servo answers",
        "nobody answers, at any baud rate or in Protocol 1.0",
        "all at once are silent where what they share fails: power, the first cable, the adapter",
        "is the supply on, and the first cable in? A servo whose LED blinks has switched itself off: power it off and on",
    ),
    "all_lost": Trouble(
        "all servos fall silent in the midst of work",
        "nobody answers any more",
        "as above",
        "look at the power plug and at the adapter's first cable; a servo whose LED blinks has switched itself off: power it "
        "off and on",
    ),
    "lost": Trouble(
        "a servo falls silent in the midst of work",
        "{who} answers no more, however long it is waited for",
        "nothing reaches it or comes back; neither this computer nor another program has a part in it",
        "look at the cable between {before} and {first}, then at {first} itself; a blinking LED is a servo that has switched "
        "itself off: power it off and on",
    ),
    "cable": Trouble(
        "one servo is silent, and all else was excluded",
        "{who} answers at no baud rate, in no protocol",
        "nothing reaches it or comes back: the cable before it, its connectors, its id, the servo itself",
        "look at the cable between {before} and {first}, then at {first} itself and its id; a blinking LED is a servo that "
        "has switched itself off: power it off and on",
    ),
}

#: why a port does not open → its words
PORT: Mapping[str, Trouble] = {
    "missing": Trouble(
        "a command finds no port", "there is no such port",
        "the adapter is not plugged in, or has another name since it was", "plug the adapter in: `openant comms ports`",
    ),
    "elsewhere": Trouble(
        "a command finds no port", "there is no such port",
        "the adapter has another name since it was plugged in; its name under /dev/serial/by-id stays",
        "the bus that is plugged in is {other}",
    ),
    "no_driver": Trouble(
        "a command finds no port although the adapter is plugged in", "there is no such port",
        "the system has not loaded the adapter's driver",
        "the adapter is plugged in, but its driver is missing: `sudo modprobe ftdi_sio`",
    ),
    "forbidden": Trouble(
        "the port is there and cannot be opened", "this user may not open it",
        "serial ports belong to a group, and this user is not in it",
        "run `sudo usermod -aG {group} $USER` and log in again",
    ),
    "forbidden_by_mode": Trouble(
        "the port is there and cannot be opened", "this user may not open it",
        "its permissions were changed", "look at its permissions",
    ),
    "held": Trouble(
        "the port is there and cannot be opened", "it is held by {who}",
        "two programs on one bus would take each other's answers", "close that program first",
    ),
    "held_by_unseen": Trouble(
        "the port is there and cannot be opened", "another program holds it",
        "as above; it is another user's or lives in a container", "close that program first",
    ),
    "dial_in": Trouble(
        "on macOS a port does not open", "{error}", "/dev/tty.… waits for a carrier that never comes", "use {other}",
    ),
    "no_port": Trouble(
        "the path is there and does not open as a port", "it does not open ({error})", "", "is this a serial port?",
    ),
    "nobody_listens": Trouble(
        "a virtual robot's address does not open", "nobody answers there ({error})",
        "the virtual robot has ended, or was never started", "start the virtual robot first",
    ),
}  # fmt: skip
