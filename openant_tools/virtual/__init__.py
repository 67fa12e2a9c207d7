"""The virtual robot: servos, flight controller and camera behind their real protocols."""
