"""Robots with levers: posture, terrain, static limits, and the simulation of a climb."""
