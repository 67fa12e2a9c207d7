"""What the engine says while a builder reads scales and tilts plates."""

from __future__ import annotations

from collections.abc import Callable

from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.errors import HardwareFault

__all__ = ["heed"]


def heed(engine: EngineProcess, notice: Callable[[str], None]) -> None:
    """Pass on what is worth knowing; raise HardwareFault where torque was switched off, with the guard's own words."""
    for event in engine.events():
        if isinstance(event, messages.Stopped):
            raise HardwareFault(event.what, where=engine.config.port, remedy=event.remedy)
        if isinstance(event, messages.Notice):
            notice(event.text)
