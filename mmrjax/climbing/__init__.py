"""Levers, posture, terrain and static limits, and a robot that climbs."""
