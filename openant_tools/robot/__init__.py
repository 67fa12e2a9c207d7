"""What an Open Ant is: joints, servo models, geometry, the nominal MJCF and `robot.toml`."""
