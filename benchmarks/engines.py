"""Which engines carry which features of the models that we write: each is run, none is asked.

    python benchmarks/engines.py play mujoco  a.json      in an environment with that engine
    python benchmarks/engines.py play mjx     b.json
    python benchmarks/engines.py play warp    c.json
    python benchmarks/engines.py table a.json b.json c.json > openant_tools/model/engines.json

A pendulum is played for half a second with and without each feature. The first file is the reference. An engine carries a feature if its
motion is nearer to the reference with it than a fifth of what the feature changes there.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

STEPS = 250
CARRIED = 0.2
POSITION = '<position joint="j" kp="8" kv="0.2" forcerange="-3 3"/>'
WEAK = '<position joint="j" kp="0.25"/>'  # never beyond the friction: the arm should stay where it is
MOTOR = '<dcmotor joint="j" input="pos" motorconst="0.6 0.6" resistance="1" controller="8 0 0.5 0 0 3"/>'


def pendulum(actuator: str = POSITION, joint: str = 'damping="0.1"', geom: str = "", sensor: str = "") -> str:
    return f"""<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody><geom name="floor" type="plane" size="1 1 1" pos="0 0 -0.095"/><body>
<joint name="j" axis="0 1 0" armature="0.006" {joint}/>
<geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.3" {geom}/></body></worldbody>
<actuator>{actuator}</actuator><sensor>{sensor or '<jointpos joint="j"/>'}</sensor></mujoco>"""


#: feature → (the model with it, without it)
MODELS: dict[str, tuple[str, str]] = {
    "delayed commands": (
        pendulum('<position joint="j" kp="8" kv="0.2" forcerange="-3 3" delay="0.03" nsample="20" interp="linear"/>'),
        pendulum(),
    ),
    "filtered setpoint": (
        pendulum('<position joint="j" kp="8" kv="0.2" forcerange="-3 3" timeconst="0.05"/>'),
        pendulum(),
    ),
    "rate-limited setpoint": (
        pendulum('<pid joint="j" kp="8" kv="0.2" forcerange="-3 3" slewmax="2"/>'),
        pendulum(),
    ),
    "motor": (pendulum(MOTOR), pendulum()),
    "damping with the square of speed": (pendulum(joint='damping="0.1 0.3"'), pendulum()),
    "dry friction that holds": (
        pendulum(WEAK, joint='damping="0.1" frictionloss="0.5" solimpfriction="0.999 0.999 0.001 0.5 2"'),
        pendulum(WEAK, joint='damping="0.1" frictionloss="0.5"'),
    ),
    "adhesion": (pendulum(geom='adhesion="20"'), pendulum()),
    "delayed sensors": (
        pendulum(sensor='<jointpos joint="j" delay="0.03" nsample="20" interp="linear"/>'),
        pendulum(),
    ),
}


def commands() -> np.ndarray:
    t = 0.002 * np.arange(STEPS)
    # (steps,) rad; down to where the arm meets the floor
    return np.asarray(0.9 * np.sign(np.sin(2 * math.pi * 4 * t)) + 0.4)


def in_mujoco(model: mujoco.MjModel) -> np.ndarray:
    data, out = mujoco.MjData(model), []
    for u in commands():
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        out.append([float(data.qpos[0]), float(data.sensordata[0])])
    return np.array(out)


def in_mjx(model: mujoco.MjModel) -> np.ndarray:
    import jax
    from mujoco import mjx

    put = mjx.put_model(model)

    def step(data: Any, u: Any) -> Any:
        data = mjx.step(put, data.replace(ctrl=data.ctrl.at[:].set(u)))
        return data, jax.numpy.stack([data.qpos[0], data.sensordata[0]])

    return np.asarray(jax.jit(lambda u: jax.lax.scan(step, mjx.make_data(model), u))(commands())[1])


def in_warp(model: mujoco.MjModel) -> np.ndarray:
    import mujoco_warp
    import warp

    data, out = mujoco.MjData(model), []
    put, state = mujoco_warp.put_model(model), mujoco_warp.put_data(model, data)
    for u in commands():
        state.ctrl.assign(np.full((1, model.nu), u, np.float32))
        mujoco_warp.step(put, state)
        warp.synchronize()
        out.append([float(state.qpos.numpy()[0, 0]), float(state.sensordata.numpy()[0, 0])])
    return np.array(out)


ENGINES: dict[str, tuple[Callable[[mujoco.MjModel], np.ndarray], str, str]] = {
    "mujoco": (in_mujoco, "MuJoCo", "mujoco"),
    "mjx": (in_mjx, "MJX", "mujoco-mjx"),
    "warp": (in_warp, "MuJoCo Warp", "mujoco-warp"),
}


def version(package: str) -> str:
    for name in (package, "mujoco-core"):
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return str(mujoco.__version__)


def play(engine: str, out: Path) -> None:
    run, title, package = ENGINES[engine]
    told: dict[str, Any] = {"engine": f"{title} {version(package)}", "features": {}}
    played: dict[str, Any] = {}
    for name, models in MODELS.items():
        for xml in models:
            if xml in played:
                continue
            try:
                played[xml] = run(mujoco.MjModel.from_xml_string(xml)).tolist()
            except Exception as error:  # whatever an engine says of what it cannot do
                played[xml] = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        told["features"][name] = [played[xml] for xml in models]
        print(name, [one if isinstance(one, str) else "played" for one in told["features"][name]], file=sys.stderr)
    out.write_text(json.dumps(told))


def verdict(reference: list[Any], other: list[Any]) -> str:
    if isinstance(other[0], str):
        return "refuses"
    column = slice(0, 2)
    with_it, without = (np.array(one)[:, column] for one in reference)
    there = np.array(other[0])[:, column]
    change = np.sqrt(np.mean((with_it - without) ** 2))
    return "carries" if np.sqrt(np.mean((there - with_it) ** 2)) <= CARRIED * change else "drops"


def table(files: list[Path]) -> None:
    told = [json.loads(path.read_text()) for path in files]
    found = {
        one["engine"]: {name: verdict(told[0]["features"][name], one["features"][name]) for name in MODELS}
        for one in told
    }
    today = datetime.date.today().isoformat()
    print(json.dumps({"made": f"benchmarks/engines.py, {today}", "engines": found}, indent=2))


if __name__ == "__main__":
    if sys.argv[1] == "play":
        play(sys.argv[2], Path(sys.argv[3]))
    else:
        table([Path(name) for name in sys.argv[2:]])
