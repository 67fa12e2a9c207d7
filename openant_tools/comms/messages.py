"""What the engine and its faces say to each other: one dataclass a message, pickled over a socket pair."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.guards import Guards
from openant_tools.comms.restart import Restart, StopCause
from openant_tools.comms.servos import Servo
from openant_tools.errors import BadInput
from openant_tools.numbers import exact
from openant_tools.recording.run import Facts

if TYPE_CHECKING:
    from openant_tools.comms.body_camera import CameraConfig

__all__ = [
    "WATCHDOG_LONGEST_S",
    "WATCHDOG_UNIT_S",
    "Command",
    "EngineConfig",
    "Event",
    "Finished",
    "Goal",
    "Hold",
    "ImuConfig",
    "LetPass",
    "Notice",
    "Play",
    "Ramp",
    "ReadRegister",
    "Record",
    "Reply",
    "Statistics",
    "Stop",
    "StopRecording",
    "Stopped",
    "TakePicture",
    "Torque",
    "WriteRegister",
]

#: The unit of the Bus Watchdog, and the most of it (register 98).
WATCHDOG_UNIT_S, WATCHDOG_LONGEST_S = 0.02, 2.54


@dataclass(frozen=True)
class ImuConfig:
    """Where the flight controller is, and how it sits in the body.

    Attributes:
        mounting_rad: rotation vector from the sensor's frame to the body's.
        gyro_bias_rad_s, acc_bias_m_s2: what it reads too much, in the body's frame.
        gyro_counts_per_dps, acc_counts_per_g: its scales as measured; 0 where they were not.
    """

    port: str
    mounting_rad: tuple[float, ...] = (0.0, 0.0, 0.0)
    gyro_bias_rad_s: tuple[float, ...] = (0.0, 0.0, 0.0)
    acc_bias_m_s2: tuple[float, ...] = (0.0, 0.0, 0.0)
    gyro_counts_per_dps: float = 0.0
    acc_counts_per_g: float = 0.0

    @property
    def calibrated(self) -> bool:
        """Whether its place in the body has been measured: before that nobody knows what it calls a lean."""
        return any((*self.mounting_rad, *self.gyro_bias_rad_s, *self.acc_bias_m_s2))


@dataclass(frozen=True)
class EngineConfig:
    """What the engine needs to own the hardware.

    Attributes:
        port: device path or `socket://` URL; a stable path survives re-plugging.
        control: control socket of a virtual robot; its clock is used where it is stepped.
        limits_rad: joint → (low, high); commands beyond are refused (`checked`), measurements far beyond stop the motion.
        registers: joint → register → counts that must be in force; EEPROM is written only where it differs.
        chain: lists of joints, each in the order of its cable from the adapter outwards, where that is known.
        watchdog_s: how long servos go on moving when nothing is heard of us any more; whole 20 ms are armed. 0, which is
            off, only where nothing moves.
        journal: file that every EEPROM write stands in before it is sent.
        still: nothing will move: torque is refused, and no register is set for a motion.
        passport: joint → register → counts as the robot's passport has them; see `state.passport_registers`.
        anyway: move although registers differ from what is expected or joints do not follow; recordings say so.

    Raises:
        BadInput: servos could move, and their watchdog would not stop them, or at once.
    """

    port: str
    servos: tuple[Servo, ...]
    baud: int = 1_000_000
    rate_hz: float = 100.0
    control: str | None = None
    limits_rad: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    registers: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    guards: Guards = field(default_factory=Guards)
    watchdog_s: float = 0.2
    write_read_gap_s: float = 0.2e-3
    imu: ImuConfig | None = None
    camera: CameraConfig | None = None
    chain: tuple[tuple[str, ...], ...] = ()
    journal: str | None = None
    still: bool = False
    passport: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    anyway: bool = False

    def __post_init__(self) -> None:
        seconds = self.watchdog_s
        if self.still or WATCHDOG_UNIT_S <= seconds <= WATCHDOG_LONGEST_S:
            return
        why = "is off, and the robot is to move" if seconds == 0 else f"cannot be {exact(seconds, 's')}"
        raise BadInput(
            f"the servos' Bus Watchdog (watchdog_s) {why}",
            remedy=f"give it {exact(WATCHDOG_UNIT_S)} to {exact(WATCHDOG_LONGEST_S, 's')} (0.2 is usual): [bus] watchdog_s in robot.toml",
        )


# ---- to the engine: each is answered by a `Reply` ------------------------------------------------------------------


@dataclass(frozen=True)
class Torque:
    """Torque of all servos on, at the position measured, their watchdogs armed before; or off.

    Attributes:
        restart: after a stop torque comes on only with the reason that `restart.Interlock` gives, or the builder.
    """

    on: bool
    restart: Restart | None = None


@dataclass(frozen=True)
class Ramp:
    """Go to a pose (joints,) rad, slowly; `Finished` follows."""

    target: NDArray[np.float64]


@dataclass(frozen=True)
class Play:
    """Play commands (n, joints) rad at the loop's rate, after a ramp to the first; `Finished` follows.

    Attributes:
        limp: (n, joints), where a joint's torque is to be off; not in the first row nor the last. Its goal follows it
            meanwhile; when its torque comes back, the goal starts there and goes to what is commanded no faster than a ramp.
    """

    commands: NDArray[np.float64]
    name: str = "motion"
    limp: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Hold:
    """Stay at the last command for `seconds`; `Finished` follows."""

    seconds: float


@dataclass(frozen=True)
class Goal:
    """A new goal (joints,) rad within the limits, for `seconds`; the reply comes when they have passed.

    It is sent as it is: ramp to where such steps begin. One beyond the limits is refused; who scales actions clips them. The telemetry's `goal` holds the number of this command in the rows
    in which it is in force.

    Attributes:
        measured: whether the reply is where the joints are, which is read after the last cycle; else telemetry tells.
        agent: when the observation was made that this answers, and when it was chosen (s, the host's monotonic clock): for
            recordings, which keep them as `obs_t` and `act_t`.
    """

    target: NDArray[np.float64]
    seconds: float
    measured: bool = True
    agent: tuple[float, float] | None = None


@dataclass(frozen=True)
class LetPass:
    """Let cycles pass for `seconds` and command nothing new; the reply comes when they have.

    It is answered while the port is gone, too, so that a face can wait for it to come back.
    """

    seconds: float


@dataclass(frozen=True)
class Record:
    """Begin a recording; the engine adds servos, registers and resolution to the facts.

    Attributes:
        resume: go on with the recording that stands there, be it torn; its facts and config stay.
        thin_s: keep one healthy cycle in so many s, all cycles around what is not as it should be, the raw bytes of what was
            lost, and counts of the rest.
        pictures: keep the overhead camera's, too: JPEG, five a second at most.
    """

    path: str
    facts: Facts
    config: str | None = None
    resume: bool = False
    thin_s: float | None = None
    pictures: bool = False


@dataclass(frozen=True)
class StopRecording:
    """Close the recording; the reply is its path and the number of cycles."""


@dataclass(frozen=True)
class Stop:
    """The stop key: torque off at once, whatever is going on."""


@dataclass(frozen=True)
class ReadRegister:
    """Counts of a register of every joint: the reply is joint → counts."""

    register: str


@dataclass(frozen=True)
class WriteRegister:
    """Set a register of one joint, in counts; see `Servos.write_counts`.

    Torque and the Bus Watchdog are the engine's own, and goals are refused while torque is off.
    """

    joint: str
    register: str
    counts: int


@dataclass(frozen=True)
class Statistics:
    """The reply is `BusStatistics.as_dict`, with the loop's own figures."""


@dataclass(frozen=True)
class TakePicture:
    """The reply is the overhead camera's newest picture, (height, width, 3) of uint8 in RGB, at most 640 wide; None without one."""


Command = (
    Torque
    | Ramp
    | Play
    | Hold
    | Goal
    | LetPass
    | Record
    | StopRecording
    | Stop
    | ReadRegister
    | WriteRegister
    | Statistics
    | TakePicture
)


# ---- from the engine ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reply:
    """The answer to command number `number`: a value, or (what, where, remedy) of an error.

    Attributes:
        cause: of the stop that is the error; None where the command was refused and nothing was stopped.
    """

    number: int
    value: Any = None
    error: tuple[str, str | None, str | None] | None = None
    cause: StopCause | None = None


@dataclass(frozen=True)
class Finished:
    """A motion has ended; its last command is held."""

    motion: str


@dataclass(frozen=True)
class Stopped:
    """Torque was switched off by a guard, the stop key, or an error; `restart.RULES` says what follows from its cause."""

    what: str
    remedy: str | None = None
    joint: str | None = None
    cause: StopCause = StopCause.UNKNOWN


@dataclass(frozen=True)
class Notice:
    """Something the user should know; nothing was stopped."""

    text: str


Event = Finished | Stopped | Notice
