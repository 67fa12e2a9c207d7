"""Bench procedures of the Open Ant paper: knee torque, stiffness by kitchen scale, floor friction by tilted plate."""
