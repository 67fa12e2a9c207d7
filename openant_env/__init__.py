"""Gymnasium environments of the Open Ant, built from one robot folder: `gymnasium.make("openant/Ant-v0")`.

`openant/AntHardware-v0` is the same on the robot itself, or on a virtual one behind its real ports.
"""

from __future__ import annotations

import gymnasium

__all__: list[str] = []

# Order enforcement and the passive checker cost more than a step's own arithmetic; `check_env` is in the tests, and a
# step before the first reset continues from the settled stand.
gymnasium.register(
    id="openant/Ant-v0", entry_point="openant_env.ant:Ant", order_enforce=False, disable_env_checker=True
)
gymnasium.register(
    id="openant/AntHardware-v0",
    entry_point="openant_env.hardware:AntHardware",
    order_enforce=False,
    disable_env_checker=True,
    nondeterministic=True,
)
