"""Other people's formats: datasets of LeRobot become runs."""
