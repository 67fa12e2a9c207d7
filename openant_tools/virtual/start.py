"""Put a whole virtual robot together: from a scenario, or the healthy standard Ant, to a server ready to run."""

from __future__ import annotations

from pathlib import Path

from openant_tools.virtual.server import Server
from openant_tools.virtual.world import World, WorldSettings, standard_servos

__all__ = ["serve"]


def serve(scenario: Path | None = None, *, clock: str | None = None, tcp: bool = False) -> Server:
    """A server for a scenario file, its ports open.

    Args:
        scenario: the file; None for a healthy standard Ant on its stand.
        clock: "real" or "stepped"; None for what the scenario says.
        tcp: put the bus on a TCP port.
    """
    world = World(WorldSettings(standard_servos()))
    return Server(world, stepped=clock == "stepped", tcp=tcp)
