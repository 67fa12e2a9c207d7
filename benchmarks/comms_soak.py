"""How long a soak on the transaction level and its diagnosis take.

    python benchmarks/comms_soak.py [--seconds 3600] [--rate 10]

Prints wall and processor time of `openant comms soak --transactions` for so many seconds of a healthy robot whose legs
swing, and of the diagnosis of a soak of 15 minutes at 100 Hz.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import TypeVar

from openant_tools.blind.soak_tables import soak_table
from openant_tools.blind.soak_virtual import swinging_soak
from openant_tools.blind.soaks import SoakAnswer
from openant_tools.comms.dropouts.diagnose import diagnose_dropouts
from openant_tools.virtual.scenario import Scenario

T = TypeVar("T")


def timed(words: str, what: Callable[[], T]) -> T:
    wall, own = time.monotonic(), time.process_time()
    result = what()
    print(f"{words}: {time.monotonic() - wall:.1f} s, of the processor {time.process_time() - own:.1f} s")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--rate", type=float, default=10.0)
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    run = timed(
        f"soak of {options.seconds:.0f} s at {options.rate:.0f} Hz, transactions",
        lambda: swinging_soak(Scenario(), options.seconds, options.rate, "soak"),
    )
    timed(f"diagnosis of its {len(run.t)} reads", lambda: diagnose_dropouts([run]))
    parameters = {"byte_error": 1e-3}
    noisy = SoakAnswer("line_noise", (), 1, "tables", 900.0, 100.0, 1_000_000, parameters=parameters)
    table = soak_table(noisy, "noisy")
    found = timed(f"diagnosis of 15 min at 100 Hz with noise, {len(table.t)} reads", lambda: diagnose_dropouts([table]))
    print(found.what)


if __name__ == "__main__":
    main()
