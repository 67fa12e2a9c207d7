"""Gymnasium environments of the Open Ant, built from one robot folder: `gymnasium.make("openant/Ant-v0")`.

`openant/Ant-v0` and `openant/AntForward-v0` are truncated after 1000 steps (120 s), so that what counts episodes has some to
count; `openant/AntContinuing-v0` is the paper's task, which has no end, and what our own agents learn in (`openant/Ant-v0` with
`max_episode_steps=-1` is the same). `openant/AntHardware-v0` is the robot itself, or a virtual one behind its real ports.
"""

from __future__ import annotations

import gymnasium

__all__: list[str] = []

#: steps, 120 s at the paper's 0.12 s
EPISODE_STEPS = 1000

for _name, _steps, _options in (
    ("Ant", EPISODE_STEPS, {}),
    ("AntForward", EPISODE_STEPS, {"task": "forward"}),
    ("AntContinuing", None, {}),
):
    # Order enforcement and the passive checker cost more than a step's own arithmetic; `check_env` is in the tests, and a
    # step before the first reset continues from the settled stand.
    gymnasium.register(
        id=f"openant/{_name}-v0",
        entry_point="openant_env.ant:Ant",
        vector_entry_point="openant_env.many:ManyAnts",
        max_episode_steps=_steps,
        kwargs=_options,
        order_enforce=False,
        disable_env_checker=True,
    )
gymnasium.register(
    id="openant/AntHardware-v0",
    entry_point="openant_env.hardware:AntHardware",
    order_enforce=False,
    disable_env_checker=True,
    nondeterministic=True,
)
