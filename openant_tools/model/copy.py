"""Another simulation of a robot: a folder with its `robot.toml` and its model, and nothing that was recorded, found or learned."""

from __future__ import annotations

from pathlib import Path

from openant_tools.errors import BadInput
from openant_tools.files import write_bytes
from openant_tools.model.mjcf import write_model
from openant_tools.model.plant import Setup, load_plant
from openant_tools.robot.folder import RobotFolder

__all__ = ["copy_robot"]


def copy_robot(source: RobotFolder, path: Path) -> RobotFolder:
    """Make a folder that describes the same robot, whose model may then be changed.

    Args:
        path: the new folder, without a robot yet; the model is written so that it finds its meshes from there.

    Raises:
        BadInput: a robot stands there already, or the source or its model cannot be read.
    """
    folder = RobotFolder(path)
    if folder.config_file.exists():
        raise BadInput(f"there is a {folder.config_file.name} already", where=path, remedy="choose another folder")
    config = source.config()
    model = source.model_path(config)
    write_model(model, load_plant(model, None, Setup.FLOOR).model, path / model.name)
    write_bytes(folder.config_file, source.config_file.read_bytes())
    if config.model != model.name:
        folder.update({"model": model.name})
    return folder
